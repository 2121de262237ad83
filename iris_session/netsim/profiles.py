"""Conditions of an impaired link over time: profiles as data, and delays as a function of seed and time alone.

    conditions = LinkConditions(load_profile("busy-wifi"), seed=1)
    conditions.compute_delay_ns("up", 3_000_000_000)      one-way delay of a byte that is sent 3 s after the start
    conditions.is_stalled("up", 3_000_000_000)            True if nothing passes then

Two runs with one profile and one seed have the same conditions at the same times, independent of the data sent. Pure.
"""

from __future__ import annotations

import math
import random
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from statistics import NormalDist
from typing import Final

import msgspec

from iris_session.protocol.errors import IrisError

UP: Final = "up"  # from clients to the session
DOWN: Final = "down"
DIRECTIONS: Final = (UP, DOWN)
#: Jitter is drawn anew this often: a wireless channel keeps its state for some milliseconds.
SLOT_NS: Final = 4_000_000
SECOND: Final = 1_000_000_000
_MASK: Final = 2**64 - 1
_NORMAL: Final = NormalDist()


class ProfileError(IrisError, ValueError):
    """The profile is invalid. The message is one line that says what would be right."""


class Direction(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One direction of a link. Bytes of a TCP connection are never lost and keep their order.

    Attributes:
        delay_ms, jitter_ms: Mean and standard deviation of the one-way delay (normal, at least 0) [ms].
        rate_mbit: Bandwidth that all connections share [Mbit/s], 0 for unlimited.
        stalled: Nothing passes.
        loss, duplicate: Probability that a datagram is lost, or duplicated.
        reorder: Probability that a datagram is delayed by `reorder_ms`, so that later ones overtake it.
    """

    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    rate_mbit: float = 0.0
    stalled: bool = False
    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    reorder_ms: float = 20.0


class ProfilePhase(Direction, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A period of a profile. The fields of `Direction` apply to both directions; `up` and `down` replace all of them.

    Attributes:
        seconds: Length [s], 0 for ever.
        at_start: `cut` closes every connection, `reset` aborts it (RST), empty does neither.
        burst_every_s, burst_s: Mean time between bursts, and length of one, in both directions [s].
        burst_ms: Delay added during a burst, drawn from 0 to this [ms].
        stall_every_s, stall_s: The same of stalls, in which nothing passes; then everything arrives at once.
        up, down: Settings of one direction.
    """

    seconds: float = 0.0
    at_start: str = ""
    burst_every_s: float = 0.0
    burst_s: float = 0.3
    burst_ms: float = 0.0
    stall_every_s: float = 0.0
    stall_s: float = 0.05
    up: Direction | None = None
    down: Direction | None = None

    def get_direction(self, name: str) -> Direction:
        """Return the settings of direction `up` or `down`."""
        return (self.up if name == UP else self.down) or self


class Profile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A sequence of phases. The last one stays in force; with `repeat` the sequence starts again.

    `window_kib`: bytes in flight per connection and direction, as bounded by the receiver's TCP window; a sender is
    blocked beyond. It limits how much stale data a stall leaves in flight.
    """

    phases: tuple[ProfilePhase, ...]
    repeat: bool = False
    window_kib: int = 256

    def __post_init__(self) -> None:
        if not self.phases:
            raise ProfileError("a profile needs a phase, for example {delay_ms = 8, jitter_ms = 3, rate_mbit = 40}")
        for phase in self.phases:
            _validate_phase(phase)
        if any(not p.seconds for p in self.phases if self.repeat or p is not self.phases[-1]):
            raise ProfileError("seconds = 0 (for ever) is for the last phase of a profile that does not repeat")
        if not 4 <= self.window_kib <= 16_384:
            raise ProfileError(f"window_kib {self.window_kib} is out of range: 4 to 16384")


def _validate_phase(phase: ProfilePhase) -> None:
    if phase.at_start not in ("", "cut", "reset"):
        raise ProfileError(f"at_start {phase.at_start!r} is not known: '', 'cut' or 'reset'")
    for part in (phase, *(d for d in (phase.up, phase.down) if d is not None)):
        for field in part.__struct_fields__:
            value = getattr(part, field)
            if not isinstance(value, float | int):
                continue
            top = 1.0 if field in ("loss", "duplicate", "reorder") else math.inf
            if not (math.isfinite(value) and 0.0 <= value <= top):
                raise ProfileError(f"{field} {value} is out of range: 0 to {'1' if top == 1.0 else 'any number'}")


_GOOD: Final = ProfilePhase(delay_ms=2.0, jitter_ms=1.0, rate_mbit=300.0, loss=0.001)
_BUSY: Final = ProfilePhase(
    delay_ms=8.0,
    jitter_ms=12.0,
    rate_mbit=40.0,
    loss=0.02,
    duplicate=0.002,
    reorder=0.01,
    burst_every_s=4.0,
    burst_s=0.3,
    burst_ms=60.0,
    stall_every_s=10.0,
    stall_s=0.12,
)
#: Profiles by name. `none` forwards as fast as it can and so measures the cost of the proxy itself.
PROFILES: Final[dict[str, Profile]] = {
    "none": Profile(phases=(ProfilePhase(),)),
    "lan": Profile(phases=(ProfilePhase(delay_ms=0.2, jitter_ms=0.05, rate_mbit=1000.0),)),
    "wan": Profile(phases=(ProfilePhase(delay_ms=40.0, jitter_ms=2.0, rate_mbit=100.0, loss=0.001),), window_kib=1024),
    "good-wifi": Profile(phases=(_GOOD,)),
    "busy-wifi": Profile(phases=(_BUSY,), window_kib=128),
    "blackout": Profile(
        phases=(
            msgspec.structs.replace(_GOOD, seconds=10.0),
            msgspec.structs.replace(_GOOD, seconds=5.0, stalled=True),
            _GOOD,
        )
    ),
}


def make_latency_profile(latency_ms: float) -> Profile:
    """Return a profile that delays by `latency_ms` each way and does nothing else."""
    return Profile(phases=(ProfilePhase(delay_ms=latency_ms),), window_kib=1024)


def load_profile(name: str) -> Profile:
    """Return a profile by name, `40ms` for a delay alone, or from a TOML or JSON file with the fields of `Profile`.

    Raises `ProfileError`.
    """
    if name in PROFILES:
        return PROFILES[name]
    if delay := re.fullmatch(r"(\d+(?:\.\d+)?)ms", name):
        return make_latency_profile(float(delay[1]))
    path = Path(name)
    if path.suffix not in (".toml", ".json"):
        raise ProfileError(f"no profile {name!r}: give one of {', '.join(PROFILES)}, 40ms, or a .toml or .json file")
    try:
        text = path.read_text(encoding="utf-8")
        return msgspec.convert(tomllib.loads(text) if path.suffix == ".toml" else msgspec.json.decode(text), Profile)
    except OSError as error:
        raise ProfileError(f"profile {name} cannot be read: {error.strerror}") from error
    except (ValueError, msgspec.MsgspecError) as error:
        raise ProfileError(f"profile {name}: {error}") from error


class RandomIntervals:
    """Random intervals: mean time between them, length. Must be queried with times that never decrease."""

    def __init__(self, rng: random.Random, every_s: float, length_s: float, start_ns: int) -> None:
        self._rng, self._every_s, self._length_ns = rng, every_s, round(length_s * SECOND)
        self.begin_ns = self.end_ns = start_ns
        self._draw_next()

    def is_active(self, t_ns: int) -> bool:
        """Return True if an interval is active at `t_ns`."""
        while t_ns >= self.end_ns and self._every_s > 0.0:
            self._draw_next()
        return self.begin_ns <= t_ns < self.end_ns

    def find_change_ns(self, t_ns: int) -> int:
        """Return when `is_active` changes next after `t_ns`."""
        return self.end_ns if self.is_active(t_ns) else self.begin_ns

    def _draw_next(self) -> None:
        if self._every_s <= 0.0:
            self.begin_ns = self.end_ns = 2**63 - 1
            return
        self.begin_ns = self.end_ns + round(self._rng.expovariate(1.0 / self._every_s) * SECOND)
        self.end_ns = self.begin_ns + self._length_ns


class LinkConditions:
    """The conditions of one link. Times are nanoseconds since its start and never decrease by more than a phase."""

    def __init__(self, profile: Profile, seed: int = 0) -> None:
        self.profile = profile
        self._seed = seed
        self._number = -1
        self._phase_end_ns = 0
        self.phase = profile.phases[0]
        self._bursts = self._stalls = RandomIntervals(random.Random(0), 0.0, 0.0, 0)
        self._enter_next_phase(0)

    def advance(self, t_ns: int, at_start: Callable[[str], None] = lambda _: None) -> None:
        """Enter the phase of `t_ns`. Calls `at_start` with `cut` or `reset` for each phase that begins so."""
        while t_ns >= self._phase_end_ns:
            self._enter_next_phase(self._phase_end_ns)
            if self.phase.at_start:
                at_start(self.phase.at_start)

    def compute_delay_ns(self, direction: str, t_ns: int) -> int:
        """Return the one-way delay of data sent at `t_ns`, without rate and stalls."""
        part = self.phase.get_direction(direction)
        slot = t_ns // SLOT_NS
        delay_ms = part.delay_ms
        if part.jitter_ms:
            delay_ms += part.jitter_ms * _NORMAL.inv_cdf(self._draw_uniform(direction, slot, 0))
        if self.phase.burst_ms and self._bursts.is_active(t_ns):
            delay_ms += self.phase.burst_ms * self._draw_uniform(direction, slot, 1)
        return round(max(0.0, delay_ms) * 1e6)

    def is_stalled(self, direction: str, t_ns: int) -> bool:
        """Return True if nothing passes at `t_ns`."""
        return self.phase.get_direction(direction).stalled or self._stalls.is_active(t_ns)

    def find_next_change_ns(self, t_ns: int) -> int:
        """Return when `is_stalled` or the phase changes next after `t_ns`."""
        return min(self._phase_end_ns, self._stalls.find_change_ns(t_ns))

    def draw(self, direction: str, number: int, event: int) -> float:
        """Return a number in (0, 1) for datagram `number`, the same in every run. `event`: 0 loss, 1 reorder, 2
        duplicate."""
        return self._draw_uniform(direction, number, 16 + event)

    def _enter_next_phase(self, begin_ns: int) -> None:
        phases = self.profile.phases
        self._number += 1
        self.phase = phases[self._number % len(phases) if self.profile.repeat else self._number]
        self._phase_end_ns = begin_ns + round(self.phase.seconds * SECOND) if self.phase.seconds else 2**63 - 1
        phase, key = self.phase, f"{self._seed}/{self._number}"
        self._bursts = RandomIntervals(random.Random(f"{key}/bursts"), phase.burst_every_s, phase.burst_s, begin_ns)
        self._stalls = RandomIntervals(random.Random(f"{key}/stalls"), phase.stall_every_s, phase.stall_s, begin_ns)

    def _draw_uniform(self, direction: str, number: int, event: int) -> float:
        """Return a uniform number in (0, 1) by hashing (splitmix64), independent of earlier calls."""
        x = (self._seed * 0x9E3779B97F4A7C15 + number * 64 + event * 2 + (direction == UP)) & _MASK
        for _ in range(2):
            x = (x + 0x9E3779B97F4A7C15) & _MASK
            x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
            x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & _MASK
            x ^= x >> 31
        return (x + 0.5) / 2**64
