"""The page of a session: when there is none, and what is said then."""

from __future__ import annotations

from pathlib import Path

import pytest

from iris_session.session.config import SessionConfig
from iris_session.session.errors import StartError
from iris_session.session.web_page import open_web_page


def test_a_folder_of_certificates_admits_no_browser_so_there_is_no_page(tmp_path: Path) -> None:
    given = {"curve": True, "web_port": 0}
    page = open_web_page(SessionConfig(**given, curve_clients=str(tmp_path)), "lab")  # type: ignore[arg-type]
    assert page.port == 0
    page = open_web_page(SessionConfig(**given), "lab")  # type: ignore[arg-type]
    assert page.port > 0
    page.close()
    page = open_web_page(SessionConfig(curve_clients=str(tmp_path), web_port=0), "lab")  # plain: everybody joins
    assert page.port > 0
    page.close()


def test_a_certificate_that_would_not_be_used_is_refused() -> None:
    with pytest.raises(StartError, match="--curve"):
        open_web_page(SessionConfig(web_port=0, web_cert="cert.pem", web_key="key.pem"), "lab")
