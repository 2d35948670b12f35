"""Attacks on the page as it runs, over plain sockets: all are refused, and it goes on."""

import http.client
import socket

import pytest

pytest_plugins = ["page_fixtures"]


def ask(server, path, method="GET", body=None, **headers):
    """(status, headers, body)"""
    link = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    names = {k.replace("_", "-"): v for k, v in headers.items()}
    try:
        link.request(method, path, body=body, headers=names)
        answer = link.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        link.close()


@pytest.fixture(scope="module")
def cookie(server):
    _, headers, _ = ask(server, "/?" + server.address.partition("?")[2])
    return headers["set-cookie"].partition(";")[0]


@pytest.fixture
def origin(server):
    return f"http://127.0.0.1:{server.port}"


PATHS = (
    "/",
    "/new",
    "/s/1",
    "/bench/bench.css",
    "/favicon.ico",
    "/docs",
    "/openapi.json",
    "/_nicegui_ws/socket.io/?EIO=4&transport=polling",
    "/_nicegui/client/x/upload/1",
)


@pytest.mark.parametrize("path", PATHS)
def test_nothing_at_all_is_served_without_the_token(server, path):
    assert ask(server, path)[0] == 401


@pytest.mark.parametrize("path", PATHS)
def test_nothing_at_all_is_served_to_another_host_name_or_origin(server, cookie, path):
    assert ask(server, path, Host="evil.example", Cookie=cookie)[0] == 403
    assert ask(server, path, Origin="http://evil.example", Cookie=cookie)[0] == 403


def handshake(server, **headers):
    """The first line that a websocket is answered with."""
    with socket.create_connection(("127.0.0.1", server.port), 30) as link:
        lines = {
            "Host": f"127.0.0.1:{server.port}",
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
            "Sec-WebSocket-Version": "13",
            **headers,
        }
        text = "".join(f"{k}: {v}\r\n" for k, v in lines.items())
        path = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
        link.sendall(f"GET {path} HTTP/1.1\r\n{text}\r\n".encode())
        return link.recv(200).partition(b"\r\n")[0].decode()


def test_a_websocket_is_opened_by_the_page_itself_only(server, cookie, origin):
    assert "101" in handshake(server, Cookie=cookie, Origin=origin)
    for headers in (
        {"Origin": origin},
        {"Cookie": cookie},
        {"Cookie": cookie, "Origin": "http://evil.example"},
        {"Cookie": cookie, "Origin": "null"},
        {"Cookie": cookie, "Origin": origin, "Host": f"evil.example:{server.port}"},
        {"Cookie": "bench=1", "Origin": origin},
    ):
        assert "403" in handshake(server, **headers)


def test_a_gigabyte_is_refused_before_it_is_sent(server, cookie, origin):
    headers = {"Cookie": cookie, "Origin": origin, "Content_Length": str(2**30)}
    status, _, body = ask(server, "/_nicegui/client/x/upload/1", "POST", b"", **headers)
    assert status == 413
    assert b"64 MiB allowed" in body


def test_a_gigabyte_that_does_not_say_its_length_is_cut_off(server, cookie, origin):
    sent = 0
    with socket.create_connection(("127.0.0.1", server.port), 60) as link:
        head = (
            f"POST /new HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nOrigin: {origin}\r\n"
            f"Cookie: {cookie}\r\nTransfer-Encoding: chunked\r\n\r\n"
        )
        link.sendall(head.encode())
        part = b"100000\r\n" + bytes(2**20) + b"\r\n"
        try:
            for _ in range(1024):
                link.sendall(part)
                sent += 2**20
        except OSError:  # it has closed the connection
            pass
    assert sent < 200 * 2**20


@pytest.mark.parametrize(
    "path",
    [
        "/s/..%2f..%2fetc",
        "/s/%2e%2e",
        "/s/.nicegui",
        "/bench/..%2fapp.py",
        "/bench/%2e%2e/app.py",
        "/_nicegui/3/static/..%2f..%2fnicegui.py",
    ],
)
def test_no_address_leads_to_other_files_or_folders(server, cookie, path):
    before = sorted(p.name for p in server.folder.parent.iterdir())
    status, _, body = ask(server, path, Cookie=cookie)
    assert status in (200, 404)
    assert b"from __future__" not in body
    assert b"root:" not in body
    assert sorted(p.name for p in server.folder.parent.iterdir()) == before


def test_a_link_with_the_token_cannot_lead_to_another_host(server):
    token = server.address.partition("?")[2]
    for path in ("//evil.example/", "/\\evil.example", "/%0d%0aSet-Cookie:x"):
        status, headers, _ = ask(server, f"{path}?{token}")
        assert status == 303
        assert headers["location"].startswith("/")
        assert not headers["location"].startswith("//")
        assert headers["set-cookie"].count("=") == 3


def test_the_page_still_answers(server, cookie):
    status, headers, body = ask(server, "/new", Cookie=cookie)
    assert status == 303
    status, headers, body = ask(server, headers["location"], Cookie=cookie)
    assert status == 200
    assert b"pam_ocp bench" in body
    assert "nonce-" in headers["content-security-policy"]
