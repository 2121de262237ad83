"""`iris-session bench`: options and defaults."""

from __future__ import annotations

import importlib
import inspect
import re

import pytest

from iris_session.cli.bench import BENCHMARKS, Range
from tests.cli.conftest import CommandLine


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


def test_a_cloth_that_is_not_square_is_refused_with_its_neighbours(cli: CommandLine) -> None:
    assert "choose 100 or 121" in cli.refuse("bench", "deformable", "--vertices", 120, status=1)
