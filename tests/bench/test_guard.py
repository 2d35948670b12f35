"""Who may ask the page for anything: hosts, origins, token and password, sizes, headers."""

import asyncio
import re

import pytest

from pam_ocp.bench.guard import HEADERS, Guard, allowed_hosts

HOST = "127.0.0.1:8300"
OWN = {"host": HOST, "origin": f"http://{HOST}"}
PAGE = "<html><script>1</script><p>&lt;script&gt;</p></html>"


class Inner:
    """An application that says what reached it."""

    def __init__(self):
        self.reached = []

    async def __call__(self, scope, receive, send):
        self.reached.append((scope["type"], scope["path"]))
        if scope["type"] == "websocket":
            await send({"type": "websocket.accept"})
            return
        more, size = True, 0
        while more:
            message = await receive()
            size, more = size + len(message.get("body", b"")), message.get("more_body", False)
        html = scope["path"] == "/"
        kind = b"text/html; charset=utf-8" if html else b"text/plain"
        headers = [(b"content-type", kind)]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        body = PAGE.encode() if html else str(size).encode()
        await send({"type": "http.response.body", "body": body})


def ask(guard, path="/", method="GET", headers=None, parts=(b"",), kind="http", ends=True):
    """(status, headers, body) of a request; the status of a websocket is its close code or 101."""
    path, _, query = path.partition("?")
    scope = {
        "type": kind,
        "path": path,
        "query_string": query.encode(),
        "headers": [(k.encode(), v.encode()) for k, v in (headers or {"host": HOST}).items()],
        "method": method,
    }
    waiting = [
        {"type": "http.request", "body": part, "more_body": not ends or i < len(parts) - 1}
        for i, part in enumerate(parts)
    ]
    sent = []

    async def receive():
        if not waiting and not ends:
            await asyncio.Event().wait()
        return waiting.pop(0) if waiting else {"type": "http.disconnect"}

    async def send(message):
        sent.append(message)

    asyncio.run(guard(scope, receive, send))
    if kind == "websocket":
        return 101 if sent[0]["type"] == "websocket.accept" else sent[0]["code"], {}, ""
    start = sent[0]
    found = {k.decode().lower(): v.decode() for k, v in start["headers"]}
    return start["status"], found, b"".join(m.get("body", b"") for m in sent[1:]).decode()


@pytest.fixture
def inner():
    return Inner()


@pytest.fixture
def guard(inner):
    hosts = allowed_hosts("127.0.0.1", 8300)
    return Guard(inner, hosts=hosts, name="bench_8300", most=1000)


def entered(guard):
    """Headers of a browser that has opened a printed address."""
    _, headers, _ = ask(guard, f"/?token={guard.ticket()}")
    return {**OWN, "cookie": headers["set-cookie"].partition(";")[0]}


# ---- token and cookie ----------------------------------------------------------------------------
def test_a_token_leaves_the_address_and_becomes_a_cookie_that_scripts_cannot_read(guard, inner):
    token = guard.ticket()
    status, headers, _ = ask(guard, f"/s/1?token={token}&tab=Data")
    assert (status, headers["refresh"]) == (200, "0;url=/s/1?tab=Data")
    assert "HttpOnly" in headers["set-cookie"]
    assert "SameSite=Strict" in headers["set-cookie"]
    assert token not in headers["set-cookie"]
    assert inner.reached == []
    assert ask(guard, headers=entered(guard))[0] == 200


def test_a_token_is_good_for_one_browser_and_its_use_is_told(guard, inner):
    used = []
    one, other = guard.ticket(lambda: used.append("one")), guard.ticket(lambda: used.append("two"))
    assert ask(guard, f"/?token={one}")[0] == 200
    assert used == ["one"]
    assert ask(guard, f"/?token={one}")[0] == 401
    assert ask(guard, f"/?token={other}", "HEAD")[0] == 401
    assert used == ["one"]
    assert ask(guard, f"/?token={other}")[0] == 200
    assert used == ["one", "two"]
    assert inner.reached == []


def test_who_has_the_cookie_already_uses_a_token_up_too(guard, inner):
    known, token = entered(guard), guard.ticket()
    assert ask(guard, f"/?token={token}", headers=known)[1]["refresh"] == "0;url=/"
    assert inner.reached == []
    assert ask(guard, f"/?token={token}", headers=known)[0] == 200
    assert inner.reached == [("http", "/")]


@pytest.mark.parametrize("path", ["/", "/?token=", "/?token=wrong", "/?token={}%00", "/s/1"])
def test_without_the_token_nothing_is_reached(guard, inner, path):
    path = path.format(guard.ticket())
    assert ask(guard, path)[0] == 401
    assert ask(guard, path, headers={**OWN, "cookie": "bench_8300=guess"})[0] == 401
    assert ask(guard, path, headers={**OWN, "cookie": "\x00;;=,"})[0] == 401
    assert inner.reached == []


def test_the_token_is_no_key_for_changes_and_leads_to_no_other_host(guard, inner):
    token = guard.ticket()
    assert ask(guard, f"/?token={token}", method="POST", headers=OWN)[0] == 401
    _, headers, _ = ask(guard, f"//evil.example/?token={token}")
    assert headers["refresh"] == "0;url=/evil.example/"
    assert inner.reached == []


# ---- hosts and origins ---------------------------------------------------------------------------
@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8300", "127.0.0.1", "127.0.0.1:8301", "", "[::1]:8300"]
)
def test_a_name_that_was_made_to_lead_here_is_refused(guard, inner, host):
    known = entered(guard)
    for kind in ("http", "websocket"):
        status = ask(guard, headers={**known, "host": host}, kind=kind)[0]
        assert status == (403 if kind == "http" else 1008)
    assert ask(guard, f"/?token={guard.ticket()}", headers={"host": host})[0] == 403
    assert inner.reached == []


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://127.0.0.1:8300", "http://127.0.0.1:8888", ""]
)
def test_another_origin_gets_nothing_even_with_the_cookie(guard, inner, origin):
    known = {**entered(guard), "origin": origin}
    assert ask(guard, headers=known)[0] == 403
    assert ask(guard, method="POST", headers=known)[0] == 403
    assert ask(guard, headers=known, kind="websocket")[0] == 1008
    assert inner.reached == []


def test_changes_and_websockets_must_say_their_origin(guard, inner):
    known = entered(guard)
    assert ask(guard, "/up", method="POST", headers=known)[0] == 200
    assert ask(guard, headers=known, kind="websocket")[0] == 101
    del known["origin"]
    assert ask(guard, headers=known)[0] == 200
    for method in ("POST", "PUT", "DELETE", "OPTIONS"):
        assert ask(guard, method=method, headers=known)[0] == 403
    assert ask(guard, headers=known, kind="websocket")[0] == 1008
    assert len(inner.reached) == 3


def test_what_another_site_embeds_is_refused_but_a_link_is_not(guard):
    known = entered(guard)
    for site in ("cross-site", "same-site"):
        embedded = {**known, "sec-fetch-site": site, "sec-fetch-mode": "no-cors"}
        assert ask(guard, headers=embedded)[0] == 403
        link = {"host": HOST, "sec-fetch-site": site, "sec-fetch-mode": "navigate"}
        assert ask(guard, f"/?token={guard.ticket()}", headers=link)[0] == 200


def test_a_host_must_be_said_once(guard):
    scope_headers = [(b"host", HOST.encode()), (b"host", b"evil.example")]
    sent = []

    async def send(message):
        sent.append(message)

    scope = {
        "type": "http",
        "path": "/",
        "query_string": b"",
        "headers": scope_headers,
        "method": "GET",
    }
    asyncio.run(guard(scope, None, send))
    assert sent[0]["status"] == 403


# ---- sizes ---------------------------------------------------------------------------------------
def test_a_body_as_long_as_allowed_passes_and_a_longer_one_does_not(guard):
    known = entered(guard)
    assert ask(guard, "/up", "POST", known, [b"x" * 600, b"x" * 400])[2] == "1000"
    assert ask(guard, "/up", "POST", known, [b"x" * 600, b"x" * 401])[0] == 413
    lying = {**known, "content-length": "10"}
    assert ask(guard, "/up", "POST", lying, [b"x" * 600] * 5)[0] == 413


def test_a_body_that_says_that_it_is_too_long_is_not_read(guard, inner):
    known = entered(guard)
    for length in ("1001", str(2**30), "-1", "1e3", "x"):
        assert ask(guard, "/up", "POST", {**known, "content-length": length})[0] == 413
    assert inner.reached == []


def test_a_body_that_does_not_end_is_not_awaited_for_ever(inner):
    """The connection stays open and says nothing more; then it says so by a header."""
    guard = Guard(inner, hosts=allowed_hosts("127.0.0.1", 8300), longest=0.2, name="bench_8300")
    known = entered(guard)
    for parts in ([b"half"], []):
        assert ask(guard, "/up", "POST", known, parts, ends=False)[0] == 408
    assert ask(guard, "/up", "POST", known, [b"whole"])[2] == "5"


def test_a_password_that_does_not_end_is_not_awaited_for_ever(locked, monkeypatch):
    monkeypatch.setattr("pam_ocp.bench.guard.LONGEST_LOGIN", 0.2)
    headers = {"host": "rig.local:8300", "origin": "http://rig.local:8300"}
    assert ask(locked, "/login", "POST", headers, [b"password=cor"], ends=False)[0] == 408


# ---- headers -------------------------------------------------------------------------------------
def test_a_browser_that_leaves_before_it_is_answered_is_no_error_of_the_page(guard):
    """What starlette makes of it, with the answer for errors behind it; others come out."""

    async def left(scope, receive, send):
        while (await receive())["type"] != "http.disconnect":
            pass
        await send({"type": "http.response.start", "status": 500, "headers": []})
        await send({"type": "http.response.body", "body": b""})
        raise RuntimeError("No response returned.")

    async def broken(scope, receive, send):
        await receive()
        raise RuntimeError("of the page's own")

    mine = entered(guard)
    guard._app = left
    ask(guard, headers=mine)
    guard._app = broken
    with pytest.raises(RuntimeError, match="own"):
        ask(guard, headers=mine)


def test_every_answer_has_the_headers_and_a_policy_without_foreign_scripts(guard):
    answers = [ask(guard), ask(guard, headers=entered(guard)), ask(guard, headers={"host": "x"})]
    for _, headers, _ in answers:
        assert HEADERS.items() <= headers.items()
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        scripts = re.search(r"script-src ([^;]*)", policy)[1]
        assert "unsafe-inline" not in scripts
        assert "http" not in scripts
        assert f"ws://{HOST}" in policy


def test_scripts_of_the_page_bear_a_nonce_that_is_new_each_time(guard):
    nonces = set()
    for _ in range(3):
        _, headers, body = ask(guard, headers=entered(guard))
        (nonce,) = re.findall(r"'nonce-([^']+)'", headers["content-security-policy"])
        assert f'<script nonce="{nonce}">1</script>' in body
        assert "&lt;script&gt;" in body
        assert int(headers["content-length"]) == len(body.encode())
        nonces.add(nonce)
    assert len(nonces) == 3


# ---- password ------------------------------------------------------------------------------------
@pytest.fixture
def locked(inner, monkeypatch):
    async def at_once(seconds):
        pass

    monkeypatch.setattr("pam_ocp.bench.guard.asyncio.sleep", at_once)
    hosts = allowed_hosts("192.168.1.5", 8300, ["rig.local"])
    return Guard(inner, hosts=hosts, password="correct horse", name="bench")


def log_in(guard, password, host="rig.local:8300"):
    headers = {"host": host, "origin": f"http://{host}"}
    return ask(guard, "/login", "POST", headers, [f"password={password}".encode()])


def test_with_a_password_the_form_is_all_that_is_seen_without_it(locked, inner):
    host = {"host": "rig.local:8300"}
    status, _, body = ask(locked, headers=host)
    assert status == 200
    assert "password" in body
    assert ask(locked, "/s/1", headers=host)[0] == 401
    assert ask(locked, "/?token=right", headers=host)[0] == 200
    assert log_in(locked, "wrong")[0] == 401
    assert inner.reached == []
    status, headers, _ = log_in(locked, "correct+horse")
    assert (status, headers["location"]) == (303, "/")
    cookie = headers["set-cookie"].partition(";")[0]
    assert ask(locked, headers={**host, "cookie": cookie})[0] == 200


def test_after_some_wrong_passwords_even_the_right_one_must_wait(locked, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("pam_ocp.bench.guard.time.monotonic", lambda: now[0])
    assert [log_in(locked, "wrong")[0] for _ in range(5)] == [401] * 5
    assert log_in(locked, "correct+horse")[0] == 429
    now[0] += 31.0
    assert log_in(locked, "correct+horse")[0] == 303


def test_a_long_form_is_no_password(locked):
    assert log_in(locked, "x" * 100_000)[0] == 401


def test_this_machine_is_no_name_of_a_page_for_others():
    assert allowed_hosts("0.0.0.0", 80, ["rig.local"]) == {"0.0.0.0:80", "rig.local:80"}
    assert "localhost:80" in allowed_hosts("127.0.0.1", 80)
