"""`iris-session robots`: show the robots found in a model, as a TOML file to edit."""

from __future__ import annotations

import argparse
import sys

from iris_session.cli.common import add_command, add_json_option, explain_no_robots, open_scene, print_result


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command `robots`."""
    parser = add_command(
        commands,
        "robots",
        run,
        help="show the robots found in a model, as TOML to edit",
        description="Print the robots found in a model. Edit the output and pass it as `serve --robots FILE`.",
        examples="""
            iris-session robots scene.xml > robots.toml
            iris-session robots handover
        """,
    )
    parser.add_argument("scene", help="MJCF or MJB file, or the name of a scene (see `iris-session serve --help`)")
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the result of `find_robots`. An ambiguous model is an error that carries the same TOML."""
    from iris_session.physics import dump_robots_toml, find_objects, find_robots

    model = open_scene(arguments.scene).model
    robots = find_robots(model)
    objects = find_objects(model)
    if not robots:
        print(explain_no_robots(model), file=sys.stderr)
    first = f"# {len(robots)} robots, {len(objects)} free objects: {', '.join(o.name for o in objects) or 'none'}"
    lines = [first, *dump_robots_toml(robots).split("\n")]
    print_result(arguments, {"robots": robots, "objects": objects}, lines)
    return 0
