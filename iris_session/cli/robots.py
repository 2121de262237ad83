"""`iris-session robots`: show the robots found in a model, as a TOML file to edit."""

from __future__ import annotations

import argparse
import sys

from iris_session.cli.common import add_command, add_json_option, explain_no_robots, open_scene, print_json


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
    import msgspec

    from iris_session.physics import dump_robots_toml, find_objects, find_robots

    model = open_scene(arguments.scene).model
    robots = find_robots(model)
    objects = find_objects(model)
    if not robots:
        print(explain_no_robots(model), file=sys.stderr)
    if arguments.json:
        print_json({"robots": msgspec.to_builtins(robots), "objects": msgspec.to_builtins(objects)})
    else:
        print(f"# {len(robots)} robots, {len(objects)} free objects: {', '.join(o.name for o in objects) or 'none'}")
        print(dump_robots_toml(robots))
    return 0
