"""Arrangement of views that a recording opens with in the Rerun viewer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from iris_session.journal.messages import RobotLabels
from iris_session.rrd import paths
from iris_session.viewer.narration import CRITICAL, ERROR, INFO, WARN
from iris_session.viewer.plots import GRIPPER, JOINTS, KINDS, TIP_SPEED, get_robot_entity

#: Eye of the 3D view, from the point that it looks at; this point, from the centre of the box of the bodies: below, so
#: that people in front of them are seen too. Both in halves of the diagonal of the box, which is at least so long [m].
EYE: Final = 1.27 * np.array((0.25, -1.75, 0.95))
BELOW: Final = np.array((0.0, 0.0, -0.15))
MIN_SIZE_M: Final = 0.3
BACKGROUND: Final = (205, 214, 224)


def place_eye(positions: NDArray[np.float64]) -> Any:
    """Return the eye that sees bodies at `positions` (n, 3) [m] from the front and above; `None` without any."""
    known = positions[np.isfinite(positions).all(axis=1)]
    if not len(known):
        return None
    low, high = np.percentile(known, (1.0, 99.0), axis=0)  # a few bodies may be parked far away
    centre = (low + high) / 2.0
    size_m = max(float(np.linalg.norm(high - low)) / 2.0, MIN_SIZE_M)
    target = centre + size_m * BELOW
    return rrb.EyeControls3D(position=target + size_m * EYE, look_target=target, eye_up=(0.0, 0.0, 1.0))


def build_blueprint(eye: Any, pictures: Sequence[str] = (), robots: Sequence[RobotLabels] = ()) -> Any:
    """Return the arrangement of views. `eye`: where the scene is seen from, `None`: the viewer chooses.

    `pictures`: streams of pictures, each with a view of its own. `robots`: those with plots, a tab for each.
    """
    hidden = ("/journal/**", paths.SAMPLES, f"{paths.PICTURES}/**", f"{paths.LANES}/**", f"{paths.METRICS}/**")
    scene = rrb.Spatial3DView(
        origin="/",
        name="Scene",
        contents=["+ /**", *(f"- {entity}" for entity in hidden)],
        background=BACKGROUND,
        line_grid=False,
        eye_controls=eye,
    )
    lanes = rrb.StateTimelineView(
        origin=paths.LANES, name="Who does what", time_view=rrb.TimeAxis(view_range=_make_whole_range())
    )
    log = rrb.TextLogView(
        origin="/",
        name="What happened",
        contents=[f"+ {paths.EVENTS}/**", f"+ {paths.DENIALS}"],
        columns=rrb.TextLogColumns(timeline_columns=[paths.SESSION_TIME], text_log_columns=["loglevel", "body"]),
        rows=rrb.TextLogRows(filter_by_log_level=[INFO, WARN, ERROR, CRITICAL]),
    )
    about = rrb.TextDocumentView(origin=paths.INFO, name="About")
    plots = rrb.Tabs(*(_build_plot(f"{paths.METRICS}/{kind}", known.view) for kind, known in KINDS.items()))
    views = (rrb.Spatial2DView(origin=f"{paths.PICTURES}/{name}", name=name) for name in pictures)
    images = [rrb.Grid(*views)] if pictures else []
    motion = [rrb.Tabs(*(_build_robot_views(robot) for robot in robots))] if robots else []
    parts = [(3, rrb.Tabs(log, about)), *((3, grid) for grid in images), *((4, tabs) for tabs in motion), (3, plots)]
    side = rrb.Vertical(*(part for _, part in parts), row_shares=[share for share, _ in parts])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(scene, lanes, row_shares=[5, 3]), side, column_shares=[5, 3]),
        rrb.TimePanel(state="collapsed", timeline=paths.SESSION_TIME, play_state="paused"),
        collapse_panels=True,
    )


def _build_robot_views(robot: RobotLabels) -> Any:
    """Return the plots of a robot: joints, and below them gripper and tip."""
    entity = get_robot_entity(robot.name)
    names = ((JOINTS, "joints"), (GRIPPER, "gripper"), (TIP_SPEED, "tip [m/s]"))
    joints, *others = (_build_plot(f"{entity}/{part}", f"{robot.name}: {name}", part == JOINTS) for part, name in names)
    return rrb.Vertical(joints, rrb.Horizontal(*others), row_shares=[3, 2], name=robot.name)


def _build_plot(entity: str, name: str, has_legend: bool = True) -> Any:
    """Return a plot that shows the whole session at first."""
    return rrb.TimeSeriesView(
        origin=entity,
        name=name,
        axis_x=rrb.TimeAxis(view_range=_make_whole_range()),
        plot_legend=rrb.PlotLegend(visible=has_legend),
    )


def _make_whole_range() -> Any:
    return rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
