"""The live view: a rendering that is steered from outside, and the page that steers it."""

import builtins
import io
import re
import shutil
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from aniso_pm.errors import InputError
from aniso_pm.pictures.output import OutputError
from aniso_pm.rendering.state import Checkpoint
from aniso_pm.view import server
from aniso_pm.view.session import Session
from aniso_pm.view.snapshot import Snapshot
from aniso_pm.view.watched import Watched
from command_line import OURS, PATH, SCENE, assert_one_line
from PIL import Image
from rooms import room

pytestmark = pytest.mark.usefixtures("without_pilot")

TOKEN = "secret"


def until(condition, seconds=60.0):
    """Wait until a condition holds that holds by itself, however busy the machine is."""
    for _ in range(int(seconds / 0.02)):
        if condition():
            return
        time.sleep(0.02)
    raise AssertionError("it never came")


# --- The rendering ---


def test_a_rendering_is_paused_questioned_begun_again_and_stopped(variant_llvm_rgb):
    world = mi.load_dict(room(size=12))
    plugin = mi.load_dict(
        {"type": "aniso_pm", "time": 1e8, "map": "global", "photon_count": 2000, "layers": "normal"}
    )
    saved = []

    def save():
        saved.append(plugin.statistics["passes"])
        return ["a.exr"]

    session = Session("room", world, world.sensors()[0], plugin, 1, 4, save)
    seen, failures = {}, []

    def steer():
        try:
            until(lambda: session.status()["passes"] >= 3)
            session.pause()
            until(lambda: session.status()["state"] == "paused")
            before = session.status()
            seen["explanation"] = session.explain(6, 8)
            assert session.status()["passes"] == before["passes"] >= 3
            assert len(before["history"]) >= 2 and before["layers"] == ["picture", "normal"]
            assert before["size"] == [12, 12] and before["left"] is None
            with pytest.raises(InputError, match="pixel 90,8"):
                session.explain(90, 8)
            session.restart({"kernel": "isotropic", "initial_radius": 0.3, "layers": ""})
            until(lambda: 1 <= session.status()["passes"] and session.status()["radius"] > 0.2)
            again = session.status()
            assert again["parameters"]["kernel"] == "isotropic" and again["layers"] == ["picture"]
            for changes, words in (
                ({"rule": "x"}, '"rule" is "x"'),
                ({"alpha": 1.0}, "'alpha' cannot be changed"),
            ):
                with pytest.raises(InputError, match=words):
                    session.restart(changes)
            session.stop()
            until(lambda: session.status()["state"] == "stopped")
            until(lambda: session.status()["message"] == "saved: a.exr")
        except BaseException as error:
            failures.append(error)
        finally:
            session.quit()

    thread = threading.Thread(target=steer)
    thread.start()
    session.run()
    thread.join()
    assert not failures, failures
    assert "pixel 6,8: " in seen["explanation"] and "64 through this pixel" in seen["explanation"]
    assert len(saved) == 1 and saved[0] >= 1


def test_the_time_that_others_take_does_not_count(variant_llvm_rgb, ticking):
    """A limit of time means rendering, not the breaks."""
    plugin = mi.load_dict({"type": "aniso_pm", "time": 0.05, "map": "global", "photon_count": 500})
    plugin.callback = lambda *_: ticking(100.0)
    plugin.render(mi.load_dict(room(size=4)), spp=1)
    assert plugin.statistics["passes"] > 2


def test_a_picture_that_cannot_be_saved_is_shown_all_the_same(variant_llvm_rgb):
    def save():
        raise OutputError("cannot write 'a.exr': no space left on device")

    world = mi.load_dict(room(size=4))
    plugin = mi.load_dict({"type": "aniso_pm", "passes": 2, "map": "global", "photon_count": 500})
    session = Session("room", world, world.sensors()[0], plugin, 0, 2, save)
    session.quit()
    session.run()
    assert session.status()["message"].startswith("not saved: cannot write 'a.exr'")


def test_what_fails_is_shown(variant_llvm_rgb):
    world = mi.load_dict(room(size=4))
    plugin = mi.load_dict({"type": "aniso_pm", "passes": 1, "initial_radius": 1e9})
    session = Session("room", world, world.sensors()[0], plugin, 0, 1, lambda: [])
    session.quit()
    session.run()
    status = session.status()
    assert status["state"] == "failed" and '"initial_radius" is 1e+09' in status["message"]


# --- A rendering elsewhere ---


def test_a_state_file_is_watched(variant_llvm_rgb, tmp_path):
    world = mi.load_dict(room(size=8), optimize=False)
    path = tmp_path / "a.state"

    def render(passes, resume):
        plugin = mi.load_dict(
            {"type": "aniso_pm", "passes": passes, "photon_count": 500, "layers": "direct"}
        )
        plugin.checkpoint = Checkpoint(path, resume=resume)
        return np.array(plugin.render(world, spp=2 * passes))

    image = render(2, False)
    watched = Watched(path)
    status = watched.status()
    assert (status["passes"], status["state"], status["steered"]) == (2, "watched", False)
    assert status["layers"] == ["picture", "direct", "standard_error"]
    assert status["parameters"]["layers"] == "direct"
    np.testing.assert_allclose(watched.snapshot.picture, image, rtol=1e-4, atol=1e-5)
    render(4, True)
    watched._look()
    assert watched.status()["passes"] == 4 and watched.snapshot.version == 2
    path.unlink()
    thread = threading.Thread(target=watched.run)
    thread.start()
    until(lambda: "No such file" in watched.status()["message"])
    assert watched.snapshot.version == 2  # what was seen stays
    watched.quit()
    thread.join()


# --- The page ---


@pytest.fixture
def client(variant_llvm_rgb):
    """The page of a rendering that only notes what is asked of it."""
    asked = []
    picture = np.linspace(0, 1, 4 * 6 * 3, dtype=np.float32).reshape(4, 6, 3)
    layers = {"depth": picture[..., :1], "normal": picture, "denoising_filter": np.ones(1)}
    shown = SimpleNamespace(
        name="<scene>",
        steered=True,
        snapshot=Snapshot(1, picture, layers),
        status=lambda: {"state": "rendering"},
        pause=lambda: asked.append("pause"),
        restart=lambda changes: asked.append(changes),
        explain=lambda x, y: f"{x},{y}",
    )
    client = server.application(shown, TOKEN, {"127.0.0.1", "localhost"}).test_client()
    client.asked, client.shown = asked, shown
    return client


def test_only_who_knows_the_token_sees_anything(client):
    for path in ("/", "/status", "/picture.png", "/static/page.js", "/?token=wrong"):
        answer = client.get(path)
        assert answer.status_code == 403 and "token" in answer.text, path
    assert client.post("/pause").status_code == 403 and not client.asked
    page = client.get(f"/?token={TOKEN}")
    assert page.status_code == 200 and "&lt;scene&gt;" in page.text
    cookie = page.headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert "default-src 'self'" in page.headers["Content-Security-Policy"]
    assert client.get("/status").json == {"state": "rendering"}  # by the cookie
    assert client.post("/pause").status_code == 200 and client.asked == ["pause"]


def test_names_that_are_not_the_pages_own_are_refused(client):
    for name in ("evil.example", "evil.example:80", "127.0.0.1.evil.example"):
        answer = client.get(f"/?token={TOKEN}", headers={"Host": name})
        assert answer.status_code == 403, name


def test_pictures_are_those_of_the_layer_and_the_exposure(client):
    def shown(**query):
        answer = client.get("/picture.png", query_string={"token": TOKEN} | query)
        assert answer.mimetype == "image/png"
        return np.array(Image.open(io.BytesIO(answer.data))).astype(float)

    plain = shown()
    assert plain.shape == (4, 6, 3) and plain.max() == 255
    assert shown(exposure="-2").mean() < plain.mean() < shown(exposure="2").mean()
    depth = shown(layer="depth")
    assert (depth == depth[..., :1]).all() and np.ptp(depth) == 255
    assert shown(layer="normal").min() >= 127


@pytest.mark.parametrize(
    "path, body, words",
    [
        ("/picture.png?layer=denoised", None, "no layer 'denoised'; there are picture, depth"),
        ("/picture.png?exposure=nan", None, "out of range"),
        ("/picture.png?exposure=x", None, "'x' is no number"),
        ("/picture.png?tonemap=agx", None, "no tone curve 'agx'"),
        ("/explain", [1], "no JSON object"),
    ],
)
def test_wrong_requests_are_told(client, path, body, words):
    client.get(f"/?token={TOKEN}")
    answer = client.get(path) if body is None else client.post(path, json=body)
    assert answer.status_code == 400 and words in answer.json["error"]


def test_what_runs_elsewhere_cannot_be_steered(client):
    client.get(f"/?token={TOKEN}")
    assert client.post("/explain", json={"x": 1, "y": 2}).json == {"text": "1,2"}
    client.shown.steered = False
    for action in ("/pause", "/restart"):
        answer = client.post(action, json={})
        assert answer.status_code == 400 and "runs elsewhere" in answer.json["error"]
    assert not client.asked


# --- The program ---


def test_wrong_usage_is_one_clear_line(run, tmp_path, monkeypatch):
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.format(integrator=PATH, extra=""))
    assert_one_line(run("view", scene), "PathIntegrator", "add --integrator aniso_pm")
    assert_one_line(run("view", scene, "--host", "0.0.0.0"), "--allow-others", "127.0.0.1")
    assert_one_line(run("view", "none.xml"), "none.xml: there is no such file")
    (tmp_path / "a.state").write_text("nothing")
    assert_one_line(run("view", "a.state"), "a.state: not a whole state file")
    options = ["--spp", "4", "-p", "map=global"]
    assert_one_line(run("view", "a.state", *options), "--spp, -p: a state", "rendered elsewhere")
    real = builtins.__import__

    def without_flask(name, *rest, **kwargs):
        if name == "flask":
            raise ImportError(name=name)
        return real(name, *rest, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_flask)
    assert_one_line(run("view", scene), "pip install 'aniso-pm[view]'")


CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium to drive the page with")
def test_the_page_in_a_browser(tmp_path):
    """Start, layers, exposure, pause, a pixel, other parameters, a phone, stop and save."""
    playwright = pytest.importorskip("playwright.sync_api")
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.format(integrator=OURS, extra=""))
    command = [sys.executable, "-m", "aniso_pm.cli", "view", scene, "-o", "a.exr"]
    program = subprocess.Popen(
        [*command, "--layers", "direct,normal"], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    )
    try:
        address = program.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]{32}", address)
        with playwright.sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            _drive(browser.new_page(viewport={"width": 1280, "height": 900}), address, playwright)
            browser.close()
        assert program.wait(60) == 0
    finally:
        program.kill()
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert {"R", "G", "B", "direct.R", "variance.R"} <= set(file.channels())
        assert file.header()["aniso_pm.parameters.kernel"] == "isotropic"


def _drive(page, address, playwright):
    expect, complaints = playwright.expect, []
    playwright.expect.set_options(timeout=60_000)
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(address)
    picture, state = page.locator("#picture"), page.locator("#state")
    expect(picture).to_have_attribute("data-version", re.compile(r"[3-9]|\d\d+"))
    expect(state).to_have_text("rendering")
    expect(page.locator("#plot polyline")).to_have_count(1)

    page.click("#pause")
    expect(state).to_have_text("paused")
    expect(page.locator("#pause")).to_have_text("Go on")
    passes = page.locator("#facts dd").first.inner_text()
    before = picture.get_attribute("src")
    page.locator("#exposure").fill("2")
    expect(page.locator("#stops")).to_have_text("2 stops")
    expect(picture).to_have_attribute("src", re.compile("exposure=2"))
    page.select_option("#layer", "normal")
    expect(picture).to_have_attribute("src", re.compile("layer=normal"))
    assert picture.get_attribute("src") != before

    picture.click(position={"x": 5, "y": 5})
    expect(page.locator("#explanation")).to_contain_text("pixel 0,0: ")
    assert page.locator("#facts dd").first.inner_text() == passes

    page.set_viewport_size({"width": 390, "height": 844})
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= 390, "the page is wider than the phone"
    page.select_option("select[name=kernel]", "isotropic")
    page.fill("input[name=initial_radius]", "-1")
    page.evaluate("document.getElementById('parameters').noValidate = true")
    page.click("text=Start again")
    expect(page.locator("#error")).to_contain_text('"initial_radius" is -1')
    page.fill("input[name=initial_radius]", "0.2")
    page.click("text=Start again")
    expect(state).to_have_text("rendering")
    expect(page.locator("#error")).to_be_hidden()
    expect(page.locator("#plot polyline")).to_have_count(1)
    page.click("#stop")
    expect(state).to_have_text("stopped")
    expect(page.locator("#message")).to_have_text("saved: a.exr")
    page.click("#quit")
    # The server refuses what it cannot do, and the page says so; nothing else is complained of.
    assert [text for text in complaints if "400" not in text and "ERR_CONN" not in text] == []
