"""`iris-session bench NAME`: measures one thing with separate processes and prints it against its bars."""

from __future__ import annotations

import argparse


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("bench", help="measure against the bars")
    parser.add_argument("bench", choices=("state", "input"))
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    raise NotImplementedError(arguments.bench)
