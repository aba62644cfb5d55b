"""The package installs as documented and finds, or refuses, its LLVM before anything aborts."""

import os
import platform
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from aniso_pm import _llvm

ROOT = Path(__file__).resolve().parent.parent

# What Dr.Jit reports with Debian 12's LLVM, which need not be installed here
PRETEND_OLD = "import drjit; drjit.detail.llvm_version = lambda: (15, 0, 6)\n"


def run_python(code, tmp_path, library=None, seconds=600):
    environment = {key: value for key, value in os.environ.items() if key != _llvm.VARIABLE}
    if library:
        environment[_llvm.VARIABLE] = str(library)
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=seconds
    )


def last_line(run):
    return run.stderr.strip().splitlines()[-1]


def old_libraries():
    """The libLLVM of this system that are older than Dr.Jit can use."""
    return [
        path
        for version in range(14, _llvm.MINIMUM)
        for path in Path("/usr/lib").glob(f"*/libLLVM-{version}.so")
    ]


def test_importing_first_gives_an_llvm_that_works(tmp_path):
    run = run_python("import aniso_pm, drjit as dr; print(dr.detail.llvm_version()[0])", tmp_path)
    assert run.returncode == 0, run.stderr
    assert int(run.stdout) >= _llvm.MINIMUM


def test_the_llvm_package_is_found_where_it_exists():
    if (sys.platform, platform.machine()) == ("linux", "x86_64"):
        library = _llvm.find_library()
        assert library.is_file() and library.name.startswith("libLLVM")


def test_a_chosen_library_is_left_alone(tmp_path):
    library = _llvm.find_library()
    if library is None:
        return  # Only where the package brings none; then there is nothing to prefer over.
    # The same file by another name stands for the user's own choice.
    chosen = library.parent / ".." / library.parent.name / library.name
    code = f"import aniso_pm, os; print(os.environ['{_llvm.VARIABLE}'])"
    assert run_python(code, tmp_path, chosen).stdout.strip() == str(chosen)


def test_an_old_llvm_loaded_earlier_is_refused_with_both_remedies(tmp_path):
    run = run_python(PRETEND_OLD + "import aniso_pm", tmp_path)
    assert run.returncode == 1
    assert last_line(run).startswith("ImportError: Dr.Jit has loaded LLVM 15.0.6")
    assert "import aniso_pm before drjit and mitsuba" in last_line(run)
    assert f"set {_llvm.VARIABLE}={_llvm.find_library()}" in last_line(run)


def test_public_modules_are_importable_by_their_names(tmp_path):
    code = "from aniso_pm.progress import bar\nfrom aniso_pm.state import Checkpoint\n"
    code += "import aniso_pm.state as state; print(state.Checkpoint is Checkpoint)"
    assert run_python(code, tmp_path).stdout == "True\n"


def test_scalar_variants_work_beside_an_old_llvm_and_llvm_variants_are_refused(tmp_path):
    code = PRETEND_OLD + (
        "import mitsuba as mi; mi.set_variant('scalar_rgb'); import aniso_pm\n"
        "for attempt in range(2):\n"
        "    try: mi.set_variant('llvm_ad_rgb')\n"
        "    except ImportError as error: print(error)\n"
        "    print(mi.variant())\n"
    )
    lines = run_python(code, tmp_path).stdout.splitlines()
    assert [line.startswith("Dr.Jit has loaded LLVM 15.0.6") for line in lines] == [1, 0, 1, 0]
    assert lines[1] == lines[3] == "scalar_rgb"


def test_a_chosen_library_that_is_missing_is_named(tmp_path):
    run = run_python("import aniso_pm", tmp_path, tmp_path / "none.so")
    assert last_line(run).startswith(f"ImportError: {_llvm.VARIABLE} names the file '{tmp_path}")
    assert "does not exist" in last_line(run)


def test_this_systems_old_libraries_are_refused_instead_of_aborting(tmp_path):
    for library in old_libraries():
        # LLVM 14 was seen once to run on for ever while Dr.Jit asked it for its version.
        try:
            run = run_python("import aniso_pm", tmp_path, library, 60)
        except subprocess.TimeoutExpired:
            run = run_python("import aniso_pm", tmp_path, library)
        assert run.returncode == 1 and last_line(run).startswith("ImportError: Dr.Jit has loaded")


def test_importing_loads_nothing_slow(tmp_path):
    slow = ("typer", "scipy", "matplotlib", "OpenEXR", "tqdm")
    code = f"import aniso_pm, sys; print([m for m in {slow} if m in sys.modules])"
    assert run_python(code, tmp_path).stdout.strip() == "[]"


ON_ONE_CORE = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import aniso_pm, mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
mi.Bitmap(np.ones((40, 30, 3), np.float32)).write("one.exr")
print(np.array(mi.Bitmap("one.exr")).shape)
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen here")
def test_pictures_are_written_and_read_on_a_single_core(tmp_path):
    """Mitsuba alone waits there for ever."""
    run = run_python(ON_ONE_CORE, tmp_path, seconds=60)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "(40, 30, 3)"


def test_reloading_as_mitsuba_3_10_does_registers_once(tmp_path):
    code = (
        "import aniso_pm, importlib, mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb'); importlib.reload(aniso_pm)\n"
        "mi.set_variant('llvm_ad_mono'); importlib.reload(aniso_pm)\n"
        "print(mi.load_dict({'type': 'aniso_pm'}) is not None)"
    )
    run = run_python(code, tmp_path)
    assert run.stdout.strip() == "True", run.stderr


def test_mitsuba_and_the_shell_find_the_package():
    entries = metadata.distribution("aniso-pm").entry_points
    found = {(entry.group, entry.name): entry.value for entry in entries}
    assert found["mitsuba", "aniso_pm"] == "aniso_pm"
    assert found["console_scripts", "aniso-pm"] == "aniso_pm.cli:main"


def test_ci_runs_the_line_that_the_readme_gives():
    line = (ROOT / ".ci" / "run").read_text().strip().splitlines()[-1]
    assert "pip install -e '.[test]'" in line
    assert line in [text.strip() for text in (ROOT / "README.md").read_text().splitlines()]


def test_every_package_is_listed_for_installation():
    text = (ROOT / "pyproject.toml").read_text()
    for init in (ROOT / "aniso_pm").rglob("__init__.py"):
        name = ".".join(init.parent.relative_to(ROOT).parts)
        assert f'"{name}"' in text, f"{name} is not in [tool.setuptools] packages"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Wheel and source distribution, built from a copy so that the sources stay clean."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for name in ("aniso_pm", "plugins", "scenes"):
        shutil.copytree(ROOT / name, source / name)
    for name in ("pyproject.toml", "LICENSE", "README.md"):
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "build", "--no-isolation", "-o", out, source]
    build = subprocess.run(command, capture_output=True, text=True)
    assert build.returncode == 0, build.stdout + build.stderr
    return next(out.glob("*.whl")), next(out.glob("*.tar.gz"))


def test_wheel_and_sdist_contain_the_plugins_and_the_gallery(built):
    wheel, sdist = built
    names = zipfile.ZipFile(wheel).namelist()
    assert {"aniso_pm/plugins/__init__.py", "aniso_pm/py.typed"} <= set(names)
    assert {"aniso_pm/scenes/teapot.xml", "aniso_pm/scenes/meshes/pan.ply"} <= set(names)
    assert wheel.stat().st_size < 8 * 2**20
    made_of = ("stability/page.html.j2", "stability/page.md.j2", "report/page.html.j2")
    for part in (*made_of, "report/results.schema.json"):
        assert f"aniso_pm/instruments/{part}" in names
    with tarfile.open(sdist) as archive:
        for part in ("/plugins/__init__.py", "/scenes/references/plain_room.exr"):
            assert any(name.endswith(part) for name in archive.getnames())


def test_the_wheel_works_without_the_sources(built, tmp_path):
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", tmp_path]
    subprocess.run([*command, built[0]], check=True)
    path = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); "
    code = "import aniso_pm.plugins; print(aniso_pm.plugins.__file__)"
    assert run_python(path + code, tmp_path).stdout.startswith(str(tmp_path))

    code = (
        "from aniso_pm import cli\n"
        "from aniso_pm.instruments import gallery\n"
        "cli.main(['scenes', 'here']); print(gallery.__file__)"
    )
    run = run_python(path + code, tmp_path)
    assert run.stdout.splitlines()[-1].startswith(str(tmp_path)), run.stderr
    for kind in ("*.xml", "meshes/*.ply", "textures/*.png", "references/*.exr"):
        copied = sorted((tmp_path / "here").glob(kind))
        shipped = sorted((ROOT / "scenes").glob(kind))
        assert [p.read_bytes() for p in copied] == [p.read_bytes() for p in shipped] != []


def test_python_started_in_a_clone_finds_the_plugins_beside_the_package(tmp_path):
    """As after `pip install .` in a clone, whose folder hides what is installed."""
    code = (
        "import sys\n"
        "sys.meta_path = [f for f in sys.meta_path if 'editable' not in repr(f).lower()]\n"
        f"sys.path.insert(0, {str(ROOT)!r})\n"
        "import aniso_pm.plugins.integrator as i; print(i.__file__)"
    )
    run = run_python(code, tmp_path)
    assert run.stdout.strip() == str(ROOT / "plugins" / "integrator.py"), run.stderr
