"""`iris-session bench`: invalid numbers are one line, before anything starts."""

from __future__ import annotations

import importlib
import inspect
import re

import pytest

from iris_session.cli.bench import _BENCHMARKS
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
        (["record", "--kills", "0"], "--kills 0: "),
        (["web", "--clients", "49"], "--clients 49: "),
        (["deformable", "--vertices", "40000"], "16 to 10000"),
        (["cloud", "--points", "10"], "10000 to"),
        (["cloud", "--cameras", "9"], "1 to 4"),
        (["cloud-stream", "--hz", "0"], "1 to 120"),
    ],
)
def test_invalid_numbers_are_one_line_error(options: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *options]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", _BENCHMARKS)
def test_every_benchmark_has_the_options_and_defaults_that_it_takes(name: str) -> None:
    module = name.replace("-", "_")
    function = getattr(importlib.import_module(f"iris_session.bench.{module}"), f"run_{module}")
    parameters = inspect.signature(function).parameters.values()
    taken = {one.name: one.default for one in parameters if one.name not in ("progress", "frames")}
    assert _BENCHMARKS[name].options == taken


def test_help_of_one_benchmark_has_its_own_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "stop", "--help"])
    shown = set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
    assert shown == {"--help", "--seconds", "--check", "--json"}
    with pytest.raises(SystemExit):
        main(["bench", "stop", "--clients", "4"])


def test_cloth_that_is_not_square_is_refused_with_its_neighbours(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "deformable", "--vertices", "120"]) == 1
    assert "choose 100 or 121" in capsys.readouterr().err
