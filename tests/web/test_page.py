"""Files of the page, headers, and the check of `Host` and `Origin`."""

from __future__ import annotations

from pathlib import Path

import pytest

from iris_session.web.origin import HostCheck, make_security_headers
from iris_session.web.page import INDEX, PageFiles


def test_without_a_page_words_say_how_to_build_it(tmp_path: Path) -> None:
    page = PageFiles(tmp_path)
    found = page.find("/")
    assert found is not None
    assert b"make web" in found.data
    assert page.find("/other.js") is None


def test_the_page_is_read_when_it_was_built(tmp_path: Path) -> None:
    page = PageFiles(tmp_path)
    page.find("/")
    (tmp_path / "assets").mkdir()
    (tmp_path / INDEX).write_text("<p>built")
    (tmp_path / "assets" / "main-Ab3_x9-Z.js").write_text("1")
    (tmp_path / "secret").symlink_to("/etc/passwd")
    index, script = page.find("/"), page.find("/assets/main-Ab3_x9-Z.js")
    assert index is not None
    assert script is not None
    assert index.data == b"<p>built"
    assert index.content_type == "text/html; charset=utf-8"
    assert (index.immutable, script.immutable) == (False, True)
    assert script.content_type == "text/javascript; charset=utf-8"
    assert page.find("/index.html") == index
    for path in ("/secret", "/../page.py", "//etc/passwd", "/assets/../index.html", "/assets", ""):
        assert page.find(path) is None, path
    (tmp_path / INDEX).write_text("<p>built again")
    assert page.find("/") != index


@pytest.mark.parametrize(
    ("host", "allowed"),
    [
        ("127.0.0.1:7725", True),
        ("192.168.0.10", True),
        ("[fe80::1]:7725", True),
        ("localhost:1", True),
        ("LAB-PC.local:7725", True),
        ("lab-pc.local.:7725", True),
        ("evil.example:7725", False),
        ("localhost.evil.example", False),
        ("lab-pc.local.evil.example", False),
        ("127.0.0.1.evil.example", False),
        ("", False),
        ("127.0.0.1:7725/x", False),
        ("a b", False),
        ("user@127.0.0.1", False),
        ("127.0.0.1:123456", False),
        ("[::1", False),
        (None, False),
    ],
)
def test_names_of_others_are_refused(host: str | None, allowed: bool) -> None:
    check = HostCheck(["lab-pc.local"], secure=True)
    assert check.find_host(host) == (host if allowed else "")
    plain = HostCheck(["lab-pc.local"], secure=False)
    is_here = allowed and host is not None and host.startswith(("127.", "localhost"))
    assert plain.find_host(host) == (host if is_here else "")


@pytest.mark.parametrize(
    ("origin", "own"),
    [
        (None, True),
        ("https://127.0.0.1:7725", True),
        ("https://127.0.0.1:7726", False),
        ("http://127.0.0.1:7725", False),
        ("https://evil.example", False),
        ("null", False),
        ("", False),
        ("https://127.0.0.1:7725/", False),
        ("https://[127.0.0.1:7725", False),
        ("https://evil@127.0.0.1:7725", False),
    ],
)
def test_pages_of_others_are_refused(origin: str | None, own: bool) -> None:
    assert HostCheck([], secure=True).is_own_origin(origin, "127.0.0.1:7725") is own


def test_the_policy_allows_nothing_from_elsewhere() -> None:
    headers = make_security_headers("10.0.0.1:7725")
    assert headers["X-Content-Type-Options"] == "nosniff"
    policy = headers["Content-Security-Policy"]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'self'"
    assert rules["connect-src"] == "'self' ws://10.0.0.1:7725 wss://10.0.0.1:7725"
    assert rules["script-src"] == "'self' 'wasm-unsafe-eval'"
    assert all(rules[name] == "'none'" for name in ("object-src", "base-uri", "form-action", "frame-ancestors"))
    assert "ws:" not in make_security_headers("")["Content-Security-Policy"]
