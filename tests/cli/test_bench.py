"""`iris-session bench`: invalid numbers are one line, before anything starts."""

from __future__ import annotations

import importlib
import inspect
import re

import pytest

from iris_session.cli.bench import BENCHMARKS, Range
from tests.cli.conftest import CommandLine


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["input", "--robots", "20"], "--robots: '20' is not a number that can be measured: give 1 to 12"),
        (["input", "--observers", "-1"], "give 0 to 64"),
        (["alignment", "--pairs", "3"], "give 10 to 100000"),
        (["join", "--assets-mb", "0.5"], "give 1 to 2000"),
        (["cloud-stream", "--hz", "0"], "give 1 to 120"),
    ],
)
def test_numbers_that_cannot_be_measured_are_refused(options: list[str], text: str, cli: CommandLine) -> None:
    assert text in cli.refuse("bench", *options)


@pytest.mark.parametrize(
    ("options", "status", "text"),
    [
        (["input", "--operators", "9", "--robots", "8"], 2, "--operators 9: "),
        (["state", "--profile", "nice-wifi"], 2, "'nice-wifi'"),
        (["deformable", "--vertices", "120"], 1, "choose 100 or 121"),
    ],
)
def test_unusable_options_are_one_line(options: list[str], status: int, text: str, cli: CommandLine) -> None:
    assert text in cli.refuse("bench", *options, status=status)


@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_has_the_options_and_defaults_that_it_takes(name: str) -> None:
    module = name.replace("-", "_")
    function = getattr(importlib.import_module(f"iris_session.bench.{module}"), f"run_{module}")
    parameters = inspect.signature(function).parameters.values()
    taken = {one.name: one.default for one in parameters if one.name not in ("progress", "frames")}
    options = BENCHMARKS[name][1].items()
    assert {option: one.default if isinstance(one, Range) else one for option, one in options} == taken


def test_help_of_one_benchmark_has_its_own_options(cli: CommandLine) -> None:
    shown = set(re.findall(r"--[a-z-]+", cli.run("bench", "stop", "--help")))
    assert shown == {"--help", "--seconds", "--check", "--json"}
    cli.refuse("bench", "stop", "--clients", "4")
