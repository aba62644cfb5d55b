"""The page and what it asks for, over HTTP.

Who knows the token may do everything: it is in the address that the program prints, and then in a
cookie that no other site can use. Requests that name another host than the page's own are refused,
so that a foreign site cannot reach the page by a name that it points to the loopback address.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import threading
from typing import Any
from urllib.parse import urlsplit

from ..errors import InputError
from ..kernel import RULES
from ..pictures.display import TONEMAPS

_COOKIE = "aniso_pm_token"
_POLICY = "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'"
_ACTIONS = ("pause", "go_on", "stop", "quit")


def check_host(host: str, allow_others: bool) -> None:
    """Raise InputError unless ``host`` is a loopback address, or others are allowed."""
    if host == "localhost" or allow_others:
        return
    try:
        if ipaddress.ip_address(host).is_loopback:
            return
    except ValueError:
        pass
    raise InputError(
        f"--host {host}: others could reach the page there; add --allow-others if they shall, "
        "or take 127.0.0.1"
    )


def application(shown, token: str, hosts: set[str] | None):
    """The Flask application that shows a ``Session`` or ``Watched``.

    hosts  names by which the page may be asked for; None: any.
    """
    from flask import Flask, Response, abort, jsonify, make_response, render_template, request

    app = Flask(__name__)

    @app.before_request
    def guard():
        if hosts is not None and urlsplit(f"//{request.host}").hostname not in hosts:
            abort(403, "this page is not known by that name")
        given = request.args.get("token") or request.cookies.get(_COOKIE, "")
        if not hmac.compare_digest(given.encode(), token.encode()):
            abort(403, "the token is missing or wrong; open the address that aniso-pm view printed")

    @app.after_request
    def headers(response):
        response.headers["Cache-Control"] = "no-store"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Content-Security-Policy"] = _POLICY
        return response

    @app.errorhandler(InputError)
    def wrong(error):
        return jsonify(error=str(error)), 400

    @app.get("/")
    def page():
        text = render_template(
            "page.html", name=shown.name, steered=shown.steered, tonemaps=TONEMAPS, rules=RULES
        )
        response = make_response(text)
        response.set_cookie(_COOKIE, token, httponly=True, samesite="Strict")
        return response

    @app.get("/status")
    def status():
        return jsonify(shown.status())

    @app.get("/picture.png")
    def picture():
        if shown.snapshot is None:
            abort(404, "no pass is finished yet")
        layer, tonemap = (
            request.args.get(k, d) for k, d in (("layer", "picture"), ("tonemap", "srgb"))
        )
        exposure = _number(request.args.get("exposure", "0"))
        return Response(shown.snapshot.png(layer, exposure, tonemap), mimetype="image/png")

    @app.post("/explain")
    def explain():
        asked = _asked(request)
        return jsonify(text=shown.explain(int(_number(asked["x"])), int(_number(asked["y"]))))

    @app.post("/restart")
    def restart():
        _steered(shown).restart(_asked(request))
        return jsonify(shown.status())

    @app.post("/<action>")
    def act(action):
        if action not in _ACTIONS:
            abort(404)
        if action != "quit":
            _steered(shown)
        getattr(shown, action)()
        return jsonify(shown.status())

    return app


def _steered(shown) -> Any:
    if not shown.steered:
        raise InputError("this rendering runs elsewhere and cannot be steered from here")
    return shown


def _asked(request) -> dict[str, Any]:
    found = request.get_json(silent=True)
    if not isinstance(found, dict):
        raise InputError("the request has no JSON object")
    return found


def _number(text: Any) -> float:
    try:
        value = float(text)
    except (TypeError, ValueError):
        raise InputError(f"'{text}' is no number") from None
    if not abs(value) <= 1e6:
        raise InputError(f"'{text}' is out of range")
    return value


def serve(shown, host: str, port: int, allow_others: bool) -> tuple[str, Any]:
    """Start to serve in a thread of its own: (address with the token, function that ends it)."""
    import logging

    try:
        from werkzeug.serving import make_server
    except ImportError as error:
        raise missing() from error
    token = secrets.token_urlsafe(24)
    hosts = None if allow_others else {"localhost", "127.0.0.1", "::1", host}
    app = application(shown, token, hosts)
    # Requests are no news on the terminal.
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    try:
        server = make_server(host, port, app, threaded=True)
    except (OSError, SystemExit) as error:
        raise InputError(f"--port {port}: cannot listen there on {host} ({error})") from error
    threading.Thread(target=server.serve_forever, daemon=True, name="view").start()
    named = f"[{host}]" if ":" in host else host
    return f"http://{named}:{server.server_port}/?token={token}", server.shutdown


def missing() -> InputError:
    """What to say where Flask is not installed."""
    return InputError("the view needs flask, which is not installed: pip install 'aniso-pm[view]'")
