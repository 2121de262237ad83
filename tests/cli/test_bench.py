"""`iris-session bench`: invalid numbers are one line, before anything starts."""

from __future__ import annotations

import pytest

from iris_session.cli.main import main


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["input", "--robots", "20"], "--robots 20: "),
        (["input", "--operators", "9", "--robots", "8"], "--operators 9: "),
        (["input", "--observers", "-1"], "takes 0 to"),
        (["state", "--clients", "0"], "--clients 0"),
        (["state", "--bodies", "0"], "--bodies 0"),
        (["alignment", "--pairs", "3"], "--pairs 3: "),
        (["slow-client", "--clients", "2"], "slow-client needs"),
        (["join", "--assets-mb", "0.5"], "--assets-mb 0.5: "),
        (["join", "--curve"], "--curve"),
        (["record", "--kills", "0"], "--kills 0: "),
        (["record", "--curve"], "--curve"),
        (["web", "--clients", "49"], "--clients 49: "),
        (["web", "--clients", "2"], "--clients 2: "),
        (["web", "--profile", "busy-wifi"], "--profile"),
    ],
)
def test_invalid_numbers_are_one_line_error(options: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *options]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1
