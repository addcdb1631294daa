"""The guard lets only the page itself through: attacks on it, as ASGI scopes."""

from __future__ import annotations

import asyncio

import pytest

from eyerender.apps.live.guard import Guard, new_token

TOKEN = new_token()
HOME = f"/{TOKEN}/"


async def answer(scope, send):
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": [(b"x-frame-options", b"ALLOWALL")]})
    await send({"type": "http.response.body", "body": b"secret"})


def ask(kind="http", path=HOME, method="GET", host=b"127.0.0.1:8123", **headers):
    """Messages that a request gets, and the scope that came through the guard, if any."""
    given = [(b"host", host)] if host is not None else []
    given += [(name.replace("_", "-").encode(), value) for name, value in headers.items()]
    scope = {"type": kind, "path": path, "method": method, "headers": given, "root_path": ""}
    sent = []

    async def receive():
        return {"type": f"{kind}.connect"}

    async def send(message):
        sent.append(message)

    passed = []

    async def behind(scope, receive, send):
        passed.append(scope)
        await answer(scope, send)

    asyncio.run(Guard(behind, TOKEN)(scope, receive, send))
    return sent, passed[0] if passed else None


def passes(*args, **kwargs):
    sent, seen = ask(*args, **kwargs)
    first = sent[0]
    ok = first["type"] == "websocket.accept" or first.get("status") == 200
    assert ok == (seen is not None)
    if not ok:
        assert first.get("status") == 403 or first["type"] == "websocket.close"
        assert b"secret" not in b"".join(m.get("body", b"") for m in sent)
    return ok


def test_tokens_are_long_and_differ():
    assert len({new_token() for _ in range(100)}) == 100
    assert len(TOKEN) >= 43


@pytest.mark.parametrize("host", [b"127.0.0.1:8123", b"localhost:8123", b"LOCALHOST:9000", b"[::1]:1", b"localhost"])
def test_the_page_opens_on_any_forwarded_port_of_the_loopback(host):
    assert passes(host=host)
    assert passes("websocket", HOME + "_nicegui_ws/socket.io/", host=host, origin=b"http://" + host.lower())


@pytest.mark.parametrize(
    "path",
    ["/", "", "//", "/x/", f"/{TOKEN[:-1]}/", f"/{TOKEN}x/", f"//{TOKEN}/", f"/x/{TOKEN}/", "/\u00e9/", "/../"],
    ids=range(10),  # names with the token would be others in every process
)
def test_a_wrong_token_is_refused(path):
    assert not passes(path=path)
    assert not passes("websocket", path, origin=b"http://127.0.0.1:8123")


@pytest.mark.parametrize(
    "host",
    [
        None, b"", b"evil.example", b"evil.example:8123", b"127.0.0.1.evil.example", b"localhost.evil.example:80",
        b"localhost@evil.example", b"0.0.0.0:8123", b"127.0.0.2", b"[::]:8123", b"127.0.0.1:8123, evil.example",
        b"127.0.0.1:8123\n", b"127.0.0.1:123456", b"2130706433", b"localhost:8123/..",
    ],
)  # fmt: skip
def test_a_host_that_was_rebound_is_refused(host):
    assert not passes(host=host)
    origin = b"http://" + (host or b"")
    assert not passes("websocket", host=host, origin=origin)


def test_two_hosts_are_refused():
    sent, seen = ask(Host=b"127.0.0.1:8123")
    assert seen is None
    assert sent[0]["status"] == 403


@pytest.mark.parametrize(
    "origin",
    [b"http://evil.example", b"null", b"https://127.0.0.1:8123", b"http://127.0.0.1:9", b"http://localhost:8123",
     b"http://127.0.0.1:8123.evil.example", b"http://127.0.0.1:8123/", b""],
)  # fmt: skip
def test_another_origin_is_refused(origin):
    assert not passes(origin=origin)
    assert not passes(method="POST", origin=origin)
    assert not passes("websocket", origin=origin)


def test_a_websocket_and_a_change_need_an_origin():
    assert not passes("websocket")
    assert not passes(method="POST")
    assert passes(method="HEAD")
    assert passes("websocket", origin=b"http://127.0.0.1:8123")
    assert passes(method="POST", origin=b"http://127.0.0.1:8123")


def test_another_site_may_only_lead_to_the_page():
    assert passes(sec_fetch_site=b"cross-site", sec_fetch_mode=b"navigate")
    assert not passes(sec_fetch_site=b"cross-site", sec_fetch_mode=b"no-cors")
    assert not passes(sec_fetch_site=b"same-site", sec_fetch_mode=b"cors")
    assert not passes(method="POST", sec_fetch_site=b"cross-site", sec_fetch_mode=b"navigate", origin=b"null")
    assert not passes("websocket", sec_fetch_site=b"cross-site", origin=b"http://127.0.0.1:8123")


def test_answers_cannot_be_framed_nor_give_the_token_away():
    sent, _ = ask()
    headers = sent[0]["headers"]
    assert (b"x-frame-options", b"DENY") in headers
    assert (b"x-frame-options", b"ALLOWALL") not in headers
    assert (b"referrer-policy", b"no-referrer") in headers
    refused, _ = ask(path="/")
    assert TOKEN.encode() not in b"".join([*dict(refused[0]["headers"]).values(), refused[1]["body"]])


def test_the_application_sees_the_token_as_its_root_and_no_headers_of_a_proxy():
    _, seen = ask(path=HOME + "x", x_forwarded_prefix=b"//evil", x_forwarded_host=b"evil", forwarded=b"host=evil")
    assert seen["root_path"] == f"/{TOKEN}"
    assert seen["path"] == HOME + "x"
    assert [name for name, _ in seen["headers"]] == [b"host"]
