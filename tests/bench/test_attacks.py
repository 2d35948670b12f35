"""Attacks on the page as it runs, over plain sockets: all are refused, and it goes on."""

import http.client
import os
import re
import socket
import time
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from browser_tools import Server

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
        return shaken(link, server, **headers)


def shaken(link, server, **headers):
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
    for path in ("//evil.example/", "/\\evil.example", "/%0d%0aSet-Cookie:x"):
        status, headers, _ = ask(server, f"{path}?{server.address.partition('?')[2]}")
        assert status == 200
        assert headers["refresh"].startswith("0;url=/")
        assert not headers["refresh"].startswith("0;url=//")
        assert headers["set-cookie"].count("=") == 3


@pytest.fixture(scope="module")
def hasty(tmp_path_factory):
    """A page that waits for a second only."""
    pytest.importorskip("nicegui")
    code = "from pam_ocp.bench import guard; guard.LONGEST_HEAD = 1.0; "
    code += "guard.MOST_CONNECTIONS = 20; from pam_ocp.cli.main import main; main()"
    made = Server(tmp_path_factory.mktemp("hasty"), run=("-c", code))
    yield made
    complaints = made.end()
    assert "Traceback" not in complaints, complaints


HEAD = "GET /new HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n"


def closed(link, within=30):
    """Whether the server ends the connection; what it said until then."""
    link.settimeout(within)
    said = b""
    try:
        while part := link.recv(10_000):
            said += part
    except ConnectionResetError:
        pass
    return said


@pytest.mark.parametrize("begin", ["", "G", HEAD, HEAD + "A: b"])
def test_a_request_that_is_never_finished_is_not_awaited_for_ever(hasty, begin):
    with socket.create_connection(("127.0.0.1", hasty.port), 30) as link:
        link.sendall(begin.format(hasty.port).encode())
        assert closed(link) == b""


def test_a_request_that_comes_letter_by_letter_is_not_awaited_for_ever(hasty):
    with socket.create_connection(("127.0.0.1", hasty.port), 30) as link:
        link.sendall(HEAD.format(hasty.port).encode())
        with pytest.raises(OSError):  # noqa: PT011, PT012 - a pipe that is broken, or was reset
            for _ in range(200):
                link.sendall(b"a")
                time.sleep(0.1)


def test_a_second_request_that_is_never_finished_is_not_awaited_either(hasty):
    head = HEAD.format(hasty.port).encode()
    with socket.create_connection(("127.0.0.1", hasty.port), 30) as link:
        link.sendall(head + b"Cookie: guessed=1\r\nConnection: keep-alive\r\n\r\n" + head)
        assert b"401" in closed(link)


def test_a_head_without_an_end_is_cut_off(server):
    sent = 0
    with socket.create_connection(("127.0.0.1", server.port), 30) as link:
        link.sendall(HEAD.format(server.port).encode() + b"A: ")
        try:
            for _ in range(200):
                link.sendall(b"a" * 2**16)
                sent += 2**16
        except OSError:
            pass
        else:
            assert closed(link) is not None
    assert sent < 200 * 2**16


def test_no_more_than_so_many_are_spoken_with_at_once_and_then_all_again(hasty):
    links = [socket.create_connection(("127.0.0.1", hasty.port), 30) for _ in range(40)]
    try:
        assert [closed(link) for link in links] == [b""] * 40
    finally:
        for link in links:
            link.close()
    assert ask(hasty, "/")[0] == 401


def test_a_websocket_outlasts_the_patience_for_a_head(hasty):
    _, headers, _ = ask(hasty, "/?" + hasty.address.partition("?")[2])
    known = {"Cookie": headers["set-cookie"].partition(";")[0]}
    known["Origin"] = f"http://127.0.0.1:{hasty.port}"
    with socket.create_connection(("127.0.0.1", hasty.port), 30) as link:
        assert "101" in shaken(link, hasty, **known)
        with pytest.raises(TimeoutError):  # nothing more is said, and it is not closed
            closed(link, within=2.5)


def test_a_token_opens_the_page_once_and_the_next_is_printed(server):
    first = server.address
    path = "/?" + first.partition("?")[2]
    assert ask(server, path)[0] == 200
    assert ask(server, path)[0] == 401
    assert server.address != first
    assert ask(server, "/?" + server.address.partition("?")[2])[0] == 200


def test_what_the_page_writes_is_for_this_user_alone(server, cookie):
    """Though the folder is open to others, which is said."""
    assert ask(server, "/new", Cookie=cookie)[0] == 303
    assert "other users of this machine may look into" in server.said
    assert "chmod go-rwx" in server.said
    written = [p for p in server.folder.rglob("*") if not p.is_symlink()]
    assert any(p.name == "lock" for p in written)
    assert [p for p in written if p.stat().st_mode & 0o077] == []


def test_the_page_still_answers(server, cookie):
    status, headers, body = ask(server, "/new", Cookie=cookie)
    assert status == 303
    status, headers, body = ask(server, headers["location"], Cookie=cookie)
    assert status == 200
    assert b"pam_ocp bench" in body
    assert "nonce-" in headers["content-security-policy"]


posix = pytest.mark.skipif(os.name != "posix", reason="a browser that is a script")


@posix
@pytest.mark.slow
def test_the_command_line_of_the_browser_holds_no_token(tmp_path):
    """All users of a machine can read it (/proc/*/cmdline)."""
    pytest.importorskip("nicegui")
    folder, seen, browser = (tmp_path / name for name in ("sessions", "seen", "browser"))
    folder.mkdir()
    browser.write_text(f'#!/bin/sh\necho "$@" > {seen}.part; mv {seen}.part {seen}\n')
    browser.chmod(0o755)
    made = Server(folder, BROWSER=f"{browser} %s")
    try:
        until = time.monotonic() + 60
        while not seen.exists() and time.monotonic() < until:
            time.sleep(0.05)
        (argument,) = seen.read_text().split()
        assert argument.startswith("file://")
        page = Path(unquote(urlsplit(argument).path))
        assert page.parent == folder
        assert page.stat().st_mode & 0o777 == 0o600
        (path,) = re.findall(r'href="http://[^/]+([^"]+)"', page.read_text())
        assert "token=" in path
        assert path not in made.said
        assert ask(made, path)[0] == 200
        assert not page.exists()
        assert ask(made, path)[0] == 401
    finally:
        made.end()


@posix
def test_a_file_for_the_browser_that_was_never_opened_goes_with_the_page(tmp_path):
    pytest.importorskip("nicegui")
    made = Server(tmp_path, BROWSER="true %s")
    assert ask(made, "/")[0] == 401  # it serves, so that its end is in order
    assert [p.name for p in tmp_path.glob(".open-*")] == [f".open-{made.process.pid}.html"]
    made.end()
    assert list(tmp_path.glob(".open-*")) == []
