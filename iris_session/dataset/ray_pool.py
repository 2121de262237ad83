"""Episodes made by tasks of a Ray cluster, one task each, or of a Ray instance of this machine.

A worker reads the recording under the path that it has here, makes the episode in a temporary folder, and returns its
files; they are written and closed here, in order. So workers need no common folder to write to, and a worker that dies
leaves nothing in the set: Ray runs its task again elsewhere.
"""

from __future__ import annotations

import os
import pickle
import platform
import re
import signal
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.dataset.episodes import DatasetError
from iris_session.dataset.run import EpisodeMaker, EpisodeTask, MadeEpisode, find_version
from iris_session.recording import NotARecordingError, RecordingError
from iris_session.system.extras import MissingExtraError, require_package

LOCAL: Final = "local"
#: How often a task whose worker dies is begun again.
RETRIES: Final = 2
#: Time for tasks that are cancelled to remove their files [s].
CANCEL_S: Final = 5.0
_MOST_CHARACTERS: Final = 300
#: In what Ray says where this module is missing.
_NOT_IMPORTED: Final = "failed to import on the worker"
#: An episode with its files by name, or why there is none. Raised in a task, an error would have a traceback as text.
TaskResult = tuple[MadeEpisode, dict[str, NDArray[np.uint8]]] | Exception


class RayPool:
    """Makes episodes in tasks of Ray: see `EpisodePool`.

    Args:
        address: As `ray.init` takes it.
        jobs: Tasks that are begun at once; None: two for each processor of the cluster.
        versions: Versions by package that workers must have.

    Raises:
        DatasetError: There is no cluster at the address, or none with this version of Ray and Python.
        MissingExtraError: Ray is not installed.
    """

    def __init__(self, address: str, jobs: int | None, versions: Mapping[str, str]) -> None:
        require_package("ray", "making episodes on a cluster")
        import ray

        self._ray, self._jobs, self._versions = ray, jobs, dict(versions)
        self._running: set[Any] = set()
        self._is_owner = not ray.is_initialized()
        if self._is_owner:
            self._connect(address)
        self._make = ray.remote(max_retries=RETRIES)(make_files)

    def _connect(self, address: str) -> None:
        options: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
        if address == LOCAL:
            options["include_dashboard"] = False
        before = signal.getsignal(signal.SIGTERM)
        try:
            with warnings.catch_warnings(action="ignore"):
                self._ray.init(address=address, **options)
        except Exception as error:  # Ray has no class for it
            raise DatasetError(f"no Ray cluster can be used at {address!r}: {_shorten(error)}") from error
        finally:
            with suppress(ValueError):  # not in the main thread
                signal.signal(signal.SIGTERM, before)  # Ray has set its own

    @property
    def depth(self) -> int:
        # Asked again and again: a cluster may grow with what waits.
        with _naming_lost_cluster():
            return self._jobs or max(2, 2 * int(self._ray.cluster_resources().get("CPU", 1)))

    def begin(self, task: EpisodeTask) -> Any:
        planned = msgspec.structs.replace(task.planned, path=os.path.abspath(task.planned.path))
        data = pickle.dumps(msgspec.structs.replace(task, planned=planned))
        try:
            with _naming_lost_cluster():
                begun = self._make.options(name=_name(task)).remote(data, self._versions)
        except ImportError as error:  # from the server of Ray Client
            raise _make_import_error("the head of the cluster", _shorten(error)) from error
        self._running.add(begun)
        return begun

    def take(self, task: EpisodeTask, begun: Any) -> MadeEpisode:
        from ray.exceptions import RayError, RayTaskError

        try:
            with _naming_lost_cluster():
                result: TaskResult = self._ray.get(begun)
        except RayTaskError as error:
            if _NOT_IMPORTED not in (said := str(error.cause)):
                raise  # a defect, with its traceback
            reason = said.strip().rpartition("\n")[2]
            at = re.search(r"ip=([^,)]+)", str(error))
            raise _make_import_error(f"node {at[1] if at else 'of the cluster'}", reason) from error
        except RayError as error:
            attempts = f"{RETRIES + 1} attempts"
            raise DatasetError(f"{_name(task)} was not made in {attempts}: {_shorten(error)}") from error
        self._running.discard(begun)
        if isinstance(result, Exception):
            raise result
        made, files = result
        folder = Path(task.folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            data.tofile(folder / name)
        return made

    def close(self) -> None:
        running = list(self._running)
        try:
            with suppress(ConnectionError):  # a lost cluster has no tasks any more
                for begun in running:
                    self._ray.cancel(begun)
                if running:
                    self._ray.wait(running, num_returns=len(running), timeout=CANCEL_S)
        finally:
            if self._is_owner:
                self._ray.shutdown()


@contextmanager
def _naming_lost_cluster() -> Iterator[None]:
    try:
        yield
    except ConnectionError as error:  # of Ray Client
        raise DatasetError(f"the Ray cluster is lost: {_shorten(error)}") from error


def _name(task: EpisodeTask) -> str:
    return f"{Path(task.planned.path).name}: episode {task.episode.number}"


def _make_import_error(node: str, reason: str) -> DatasetError:
    return DatasetError(f"{node} has no usable iris-session ({reason}): install the same on every node")


def _shorten(error: BaseException) -> str:
    """Return what an error says, on one line."""
    return " ".join(str(error).split())[:_MOST_CHARACTERS] or type(error).__name__


# --- on the worker ----------------------------------------------------------------------------------------------------

_maker: EpisodeMaker | None = None


def make_files(task: bytes, versions: Mapping[str, str]) -> TaskResult:
    """Make an episode in a worker, which keeps files and renderer open for the next.

    Args:
        task: The task, pickled: a worker with another version of this package may not be able to read it.
        versions: Versions by package that are needed.
    """
    global _maker  # noqa: PLW0603
    node = platform.node()
    for package, wanted in versions.items():
        if wanted and (here := find_version(package)) != wanted:
            has = f"has {package} {here}, not {wanted}" if here else f"has no {package} {wanted}"
            return DatasetError(f"node {node} {has}: install the same on every node")
    given: EpisodeTask = pickle.loads(task)
    try:
        with tempfile.TemporaryDirectory(prefix="iris-export-") as folder:
            _maker = _maker or EpisodeMaker()
            made = _maker.make(msgspec.structs.replace(given, folder=folder))
            return made, {path.name: np.fromfile(path, np.uint8) for path in sorted(Path(folder).iterdir())}
    except NotARecordingError as error:
        return DatasetError(f"node {node}: {error}: every node needs the recordings under the same paths")
    except (RecordingError, MissingExtraError) as error:
        return type(error)(f"node {node}: {error}")
    except OSError as error:
        return DatasetError(f"node {node}: {_shorten(error)}")
