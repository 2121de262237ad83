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
        (["state", "--profile", "nice-wifi"], "'nice-wifi'"),
        (["alignment", "--pairs", "3"], "--pairs 3: "),
        (["slow-client", "--clients", "2"], "--clients 2: "),
        (["join", "--assets-mb", "0.5"], "--assets-mb 0.5: "),
        (["join", "--curve"], "--curve"),
        (["record", "--kills", "0"], "--kills 0: "),
        (["record", "--curve"], "--curve"),
        (["web", "--clients", "49"], "--clients 49: "),
        (["web", "--profile", "busy-wifi"], "--profile"),
        (["deformable", "--vertices", "40000"], "16 to 10000"),
        (["cloud", "--points", "10"], "10000 to"),
        (["cloud", "--cameras", "9"], "1 to 4"),
        (["cloud-stream", "--hz", "0"], "1 to 120"),
        (["cloud-stream", "--profile", "lan"], "--mbit"),
    ],
)
def test_invalid_numbers_are_one_line_error(options: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *options]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


def test_cloth_that_is_not_square_is_refused_with_its_neighbours(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "deformable", "--vertices", "120"]) == 1
    assert "choose 100 or 121" in capsys.readouterr().err
