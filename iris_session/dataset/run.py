"""`export_dataset`: plans a data set, makes its episodes, in several processes if wanted, and closes them in order.

An episode is one task, which depends on its arguments only; so it can be made anywhere (`EpisodePool`), and only
closing it needs to know how many there are. A run that was killed is continued by the next one with the same arguments.
Not here: episodes made on a cluster (`ray_pool`).
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import shutil
import signal
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import msgspec
import numpy as np

from iris_session.dataset.cameras import CameraSet, PictureSpec, RecordedCamera, find_streams
from iris_session.dataset.episodes import (
    DatasetError,
    Plan,
    PlannedEpisode,
    PlannedRecording,
    PlanOptions,
    identify_recording,
    make_plan,
)
from iris_session.dataset.files import PARTIAL, PictureSink, Stats, lock_folder
from iris_session.dataset.formats import FORMATS, MODEL, make_sink, open_writer
from iris_session.dataset.frames import (
    SESSION_TIME,
    EpisodeLeftOutError,
    FrameReader,
    Schema,
    Table,
    make_age_key,
    make_schema,
)
from iris_session.recording import Recording
from iris_session.replay.simulation import Replay
from iris_session.session.core import SessionCore
from iris_session.system.process import die_with_parent, is_parent

#: Of the bytes that the same recordings give: 2 since looks are drawn each into its own framebuffer, and x264 follows
#: from the pictures alone. A set of an earlier one is not continued.
REVISION: Final = 2
#: Packages whose version changes the bytes of a set, beside those of its format.
_PACKAGES: Final = ("iris-session", "mujoco", "numpy", "pillow")
#: Finished episodes that wait for an earlier one, per process.
_AHEAD: Final = 2
#: File of what a process has made, in the folder of its task.
_MADE: Final = "made.pickle"


class DatasetOptions(msgspec.Struct, frozen=True):
    """Options of an export.

    Attributes:
        fps: Frames a second of simulated time, at most the rate of the ticks.
        pictures: Cameras, size and looks; without cameras no picture is drawn.
        choice: Which episodes.
        jobs: Processes.
    """

    fps: int = 30
    pictures: PictureSpec = PictureSpec()
    choice: PlanOptions = PlanOptions()
    jobs: int = 1


class Shares(NamedTuple):
    """Seconds that an episode took, once its recording is open: in all, drawing, encoding; and of the processor."""

    total_s: float
    draw_s: float
    encode_s: float
    cpu_s: float


class DatasetReport(msgspec.Struct, frozen=True):
    """Result of an export. `episodes`, `frames`: of the whole set, which earlier runs may have begun.

    `seconds`: of the processor, for each episode of this run in order; `closing`: those of closing it among them.
    `shares`: of their time, in re-simulation, drawing, encoding, and closing.
    """

    folder: str
    format: str
    episodes: int
    frames: int
    tasks: tuple[str, ...]
    notes: tuple[str, ...]
    left_out: tuple[str, ...] = ()
    seconds: tuple[float, ...] = ()
    closing: tuple[float, ...] = ()
    shares: dict[str, float] = {}


class EpisodeTask(msgspec.Struct, frozen=True):
    """Everything that making an episode needs. `to`: format. `folder`: for its pictures."""

    index: int
    to: str
    planned: PlannedRecording
    episode: PlannedEpisode
    schema: Schema
    pictures: PictureSpec
    folder: str


class MadeEpisode(NamedTuple):
    """An episode that was made. `left_out`: why it has no frames, else empty."""

    table: Table | None
    pictures: dict[tuple[int, str], Stats]
    shares: Shares
    left_out: str = ""
    notes: tuple[str, ...] = ()


class EpisodeMaker:
    """Makes episodes, of one recording after the other: files, scene and renderer stay open meanwhile."""

    def __init__(self) -> None:
        self._recording: Recording | None = None
        self._reader: FrameReader | None = None
        self._cameras: CameraSet | None = None
        self._recorded: list[RecordedCamera] = []
        self._key: Any = None
        self._index = -1

    def make(self, task: EpisodeTask) -> MadeEpisode:
        """Make one episode: its frames, and its pictures in a folder.

        Raises:
            RecordingError: The recording does not verify, or cannot be drawn, or is of another kind than the set.
            OSError: The folder cannot be written to.
        """
        self._open(task)
        began, began_cpu = time.perf_counter(), time.process_time()

        def measure() -> Shares:
            cpu_s = time.process_time() - began_cpu
            return Shares(time.perf_counter() - began, draw_s, encode_s, cpu_s)

        assert self._reader is not None
        assert self._recording is not None
        recording, cameras = self._recording, self._cameras
        draw_s = encode_s = 0.0
        folder = Path(task.folder)
        folder.mkdir(parents=True, exist_ok=True)
        sink = make_sink(task.to, folder, task.schema, task.pictures)

        def draw(core: SessionCore) -> None:
            nonlocal draw_s, encode_s
            if cameras is None:
                return
            at = time.perf_counter()
            for look, camera, image in cameras.draw(core, recording):
                drawn = time.perf_counter()
                sink.add(look, camera, image)
                draw_s, encode_s, at = draw_s + drawn - at, encode_s + time.perf_counter() - drawn, time.perf_counter()

        try:
            table = self._reader.read(task.episode, draw)
            at = time.perf_counter()
            for camera in self._recorded:
                table = add_recorded(table, camera, sink, task.pictures.looks)
            encode_s += time.perf_counter() - at
        except EpisodeLeftOutError as error:
            sink.abort()
            return MadeEpisode(None, {}, measure(), str(error))
        except BaseException:
            self._key = None  # the session may be within a step
            with suppress(Exception):
                sink.abort()
            raise
        if FORMATS[task.to].has_layers:
            (folder / MODEL).write_bytes(self._reader.core.world.encode_model())
        at = time.perf_counter()
        stats = sink.close()
        encode_s += time.perf_counter() - at
        notes = tuple(cameras.notes) if cameras is not None else ()
        return MadeEpisode(table, stats, measure(), "", notes)

    def _open(self, task: EpisodeTask) -> None:
        """Open the recording and the renderer of a task, unless they are open and at an earlier episode."""
        key = task.planned, task.schema, task.pictures
        is_later, self._index = task.index > self._index, task.index
        if key == self._key and is_later:
            return
        self.close()
        self._recording = Recording.open(task.planned.path, warn=False)
        if identify_recording(self._recording) != task.planned.id:
            raise DatasetError(f"{task.planned.path} is not the recording of that path that was planned")
        self._reader = FrameReader(self._recording, task.planned, task.schema)
        cameras = task.pictures.cameras
        self._recorded = [RecordedCamera(self._recording, one) for one in cameras if one.stream]
        if drawn := tuple(one for one in cameras if not one.stream):
            self._cameras = CameraSet(msgspec.structs.replace(task.pictures, cameras=drawn))
        self._key = key

    def close(self) -> None:
        """Close what is open."""
        self._reader = self._key = None
        self._recorded = []
        if self._cameras is not None:
            self._cameras.close()
            self._cameras = None
        if self._recording is not None:
            self._recording.close()
            self._recording = None


def add_recorded(table: Table, camera: RecordedCamera, sink: PictureSink, looks: int) -> Table:
    """Add the pictures of a real camera to a sink. Return the frames with their ages.

    Raises:
        EpisodeLeftOutError: Frames have no picture.
    """
    times, captures, name = table.columns[SESSION_TIME], [], camera.spec.name
    for image, capture_ns in camera.read(times[:, 0].tolist()):
        for look in range(looks + 1):
            sink.add(look, name, image)
        captures.append(capture_ns)
    ages = (times - np.array(captures)[:, None]) * 1e-9
    repeated = len(captures) - len(set(captures))
    notes = table.notes
    if repeated:
        notes += (
            f"{repeated} of {len(times)} frames repeat a picture of {name}; they are up to {ages.max():.2f} s old",
        )
    return Table({**table.columns, make_age_key(name): ages}, table.states, notes)


def export_dataset(
    files: Sequence[Path],
    folder: Path,
    to: str,
    options: DatasetOptions | None = None,
    progress: Callable[[str], None] | None = None,
    open_pool: Callable[[dict[str, str]], EpisodePool] | None = None,
) -> DatasetReport:
    """Write a data set of recordings, or finish one that was begun with the same arguments.

    Args:
        files: Recordings, as by `list_files`.
        folder: For the set. Every episode is on the disk before the next is closed.
        to: One of `FORMATS`.
        options: What frames have; None for numbers at 30 Hz.
        progress: Called now and then with a text that says how far it is.
        open_pool: Returns what makes the episodes, for example `partial(RayPool, "auto", None)`, given the versions
            that it has to have, by package; None: processes of this machine.

    Returns:
        What the set holds.

    Raises:
        DatasetError: The recordings do not fit together, or the folder has something else.
        ReplayError: A recording does not verify here: a step gives another result.
        RecordingError: A file cannot be read or drawn.
    """
    options, say = options or DatasetOptions(), progress or (lambda text: None)
    if to not in FORMATS:
        raise ValueError(f"{to!r}: give one of {', '.join(FORMATS)}")
    say("reading")
    plan = make_plan(files, options.choice)
    schema, options = _find_schema(plan, options)
    request = _make_request(to, plan, schema, options)
    try:
        with lock_folder(folder):
            try:
                return _write(folder, to, plan, schema, options, request, say, open_pool)
            except OSError:
                shutil.rmtree(folder / PARTIAL, ignore_errors=True)  # on a full disk others need the place
                raise
    except OSError as error:
        reason = " ".join((error.strerror or str(error)).split())
        raise DatasetError(f"the data set cannot be written to {folder}: {reason}") from error


def _find_schema(plan: Plan, options: DatasetOptions) -> tuple[Schema, DatasetOptions]:
    """Return the columns of the first recording with an episode, and options with the cameras that it has."""
    with Recording.open(plan.recordings[plan.episodes[0].recording].path, warn=False) as recording:
        core = Replay(recording).core
        pictures = find_streams(options.pictures, core.world.model, recording)
        recorded = tuple(one.name for one in pictures.cameras if one.stream)
        schema = msgspec.structs.replace(make_schema(core, options.fps), recorded=recorded)
        return schema, msgspec.structs.replace(options, pictures=pictures)


def _make_request(to: str, plan: Plan, schema: Schema, options: DatasetOptions) -> dict[str, Any]:
    """Return all that the bytes of a set follow from, as plain values."""
    episodes = [msgspec.to_builtins(one) for one in plan.episodes]
    return {
        "format": to,
        "revision": REVISION,
        "fps": schema.fps,
        "pictures": msgspec.to_builtins(options.pictures),
        "recordings": [one.id for one in plan.recordings],
        "episodes": episodes,
        "people": list(plan.people),
        "schema": msgspec.to_builtins(schema),
        "versions": {name: find_version(name) for name in (*_PACKAGES, *FORMATS[to].packages.values())},
    }


def find_version(package: str) -> str:
    """Return the version of an installed package, empty if it is not."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def _write(
    folder: Path,
    to: str,
    plan: Plan,
    schema: Schema,
    options: DatasetOptions,
    request: dict[str, Any],
    say: Callable[[str], None],
    open_pool: Callable[[dict[str, str]], EpisodePool] | None,
) -> DatasetReport:
    writer = open_writer(to, folder, plan, schema, options.pictures, request)
    first, first_look = writer.next
    tasks = [
        EpisodeTask(
            i,
            to,
            plan.recordings[episode.recording],
            episode,
            schema,
            options.pictures,
            str(writer.partial / f"{i:06d}"),
        )
        for i, episode in enumerate(plan.episodes)
        if i >= first
    ]
    notes = list(plan.notes)
    left_out: list[str] = []
    seconds: list[float] = []
    closed: list[float] = []
    total_s = draw_s = encode_s = close_s = 0.0
    say(f"{first} of {len(plan.episodes)} episodes")
    jobs = min(options.jobs, len(tasks))
    pool: EpisodePool
    if open_pool is not None and tasks:
        pool = open_pool(request["versions"])
    else:
        pool = ProcessPool(jobs) if jobs > 1 else _OwnProcess()
    with closing(make_in_order(tasks, pool)) as episodes:
        for task, made in episodes:
            where = f"{Path(task.planned.path).name}: episode {task.episode.number}"
            began, began_cpu = time.perf_counter(), time.process_time()
            if made.table is None:
                left_out.append(f"{where} is left out: {made.left_out}")
            else:
                for look in range(options.pictures.looks + 1):
                    if (task.index, look) >= (first, first_look):
                        writer.close_episode(task.index, look, made.table, made.pictures, Path(task.folder))
                notes += [f"{where}: {note}" for note in made.table.notes]
            notes += [note for note in made.notes if note not in notes]
            shutil.rmtree(task.folder, ignore_errors=True)
            closing_s = time.perf_counter() - began
            closed.append(time.process_time() - began_cpu)
            seconds.append(made.shares.cpu_s + closed[-1])
            total_s, close_s = total_s + made.shares.total_s + closing_s, close_s + closing_s
            draw_s, encode_s = draw_s + made.shares.draw_s, encode_s + made.shares.encode_s
            say(f"{task.index + 1} of {len(plan.episodes)} episodes")
    writer.finish()
    rest_s = total_s - draw_s - encode_s - close_s
    shares = {"resimulate": rest_s, "draw": draw_s, "encode": encode_s, "close": close_s}
    return DatasetReport(
        *(str(folder), to, writer.n_episodes, writer.n_frames, plan.tasks, tuple(notes), tuple(left_out)),
        *(tuple(seconds), tuple(closed), {name: one / total_s for name, one in shares.items()} if total_s else {}),
    )


class EpisodePool(Protocol):
    """Makes episodes, several at once. `depth`: how many may be begun before the first of them is taken."""

    @property
    def depth(self) -> int: ...

    def begin(self, task: EpisodeTask) -> Any:
        """Begin an episode. Return what `take` needs to know of it."""

    def take(self, task: EpisodeTask, begun: Any) -> MadeEpisode:
        """Wait for an episode, and return it; its pictures are in the folder of its task. Raises what making it did."""

    def close(self) -> None:
        """Cancel what is not made, and end what makes it."""


def make_in_order(
    tasks: Sequence[EpisodeTask], pool: EpisodePool
) -> Generator[tuple[EpisodeTask, MadeEpisode], None, None]:
    """Yield the episodes in order, and close the pool at the end, or when one fails."""
    begun: deque[tuple[EpisodeTask, Any]] = deque()
    ahead = iter(tasks)
    try:
        while True:
            for task in islice(ahead, max(0, pool.depth - len(begun))):
                begun.append((task, pool.begin(task)))
            if not begun:
                return
            task, what = begun.popleft()
            yield task, pool.take(task, what)
    finally:
        pool.close()


class _OwnProcess:
    """Makes one episode after the other, in this process."""

    depth = 1

    def __init__(self) -> None:
        self._maker = EpisodeMaker()

    def begin(self, task: EpisodeTask) -> None:
        pass

    def take(self, task: EpisodeTask, begun: None) -> MadeEpisode:
        return self._maker.make(task)

    def close(self) -> None:
        self._maker.close()


class ProcessPool:
    """Makes episodes in processes of this machine. They are spawned: OpenGL and threads do not survive a fork."""

    def __init__(self, jobs: int) -> None:
        self.depth = _AHEAD * jobs
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(jobs, context, _begin_worker, (os.getpid(),))

    def begin(self, task: EpisodeTask) -> Future[None]:
        with _naming_killed_process():
            return self._pool.submit(make_episode, task)

    def take(self, task: EpisodeTask, begun: Future[None]) -> MadeEpisode:
        with _naming_killed_process():
            begun.result()
        made: MadeEpisode = pickle.loads((Path(task.folder) / _MADE).read_bytes())
        return made

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)


@contextmanager
def _naming_killed_process() -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool as error:
        raise DatasetError("a process that made an episode was killed: give fewer --jobs if memory is short") from error


_maker: EpisodeMaker | None = None


def _begin_worker(parent: int) -> None:
    """Prepare a process that makes episodes: it ends with the one that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(signal.SIGKILL)
    if not is_parent(parent):  # it was killed while this one began
        os._exit(1)


def make_episode(task: EpisodeTask) -> None:
    """Make one episode in a process that keeps files and renderer open for the next.

    The result goes through a file: a process that is killed while it writes a large one to the pipe that all share
    would leave half of it there, and the lock of the pipe, and the others would wait forever.
    """
    global _maker  # noqa: PLW0603
    _maker = _maker or EpisodeMaker()
    made = _maker.make(task)
    (Path(task.folder) / _MADE).write_bytes(pickle.dumps(made))
