"""Exceptions of the client.

    ClientError
    +-- NotConnectedError      no connection to a session now; the client keeps trying unless it was closed or refused
    +-- RefusedError           the session refused `hello`: `code`, `message`, `advice`
    |   +-- VersionError       it speaks other protocol versions: `supported_versions`
    +-- DeniedError            the session denied a request: `denial` (reason, holder, advice); nothing changed
    +-- RequestTimeoutError    no answer in time (also a `TimeoutError`); the request may still take effect,
    |                          but for an `acquire`, which is withdrawn
    +-- UnreachedError         a motion did not end in time (also a `TimeoutError`): how far away, and why
    +-- InvalidMessageError    a message does not fit the protocol (also a `ValueError`); nothing was sent
    +-- IdentityError          the identity file cannot be used
    +-- TrustError             the session's key is not the trusted one, or it could not prove the join code
    +-- AssetError             an asset could not be fetched: `address`, `reason`
    +-- SessionNameError       the name does not identify a single session

Malformed messages from a server never raise: they are counted in `Client.counters`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from iris_session.assets.errors import AssetStoreError
from iris_session.protocol.common import Denial
from iris_session.protocol.errors import IrisError
from iris_session.protocol.names import HoldReason
from iris_session.protocol.server_messages import Feedback, Refused

#: What would be right where a limit is active.
LIMIT_ADVICE: Final = {
    "reach": "choose a pose within its reach",
    "proximity": "another robot is near: go around it, or move it away first",
}


class ClientError(IrisError):
    """Base of all errors of the client."""


def join_parts(*parts: str) -> str:
    """Join the non-empty parts to one line."""
    return "; ".join(part for part in parts if part)


class NotConnectedError(ClientError):
    """There is no connection to a session."""


class RefusedError(ClientError):
    """The session refused `hello`.

    Args:
        refused: Its answer.

    Attributes:
        code: A `RefusalCode` or a `DenialReason`.
        message: What is wrong, in words.
        advice: What to do.
    """

    def __init__(self, refused: Refused) -> None:
        super().__init__(f"refused ({refused.code}): {join_parts(refused.message, refused.advice)}")
        self.code = refused.code
        self.message = refused.message
        self.advice = refused.advice


class VersionError(RefusedError):
    """The session speaks other protocol versions than this client.

    Args:
        refused: Its answer.

    Attributes:
        supported_versions: Versions that it speaks.
    """

    def __init__(self, refused: Refused) -> None:
        super().__init__(refused)
        self.supported_versions = refused.supported_versions


class DeniedError(ClientError):
    """The session denied a request, and changed nothing.

    Args:
        denial: Its answer.

    Attributes:
        denial: The answer: reason, message, holder and advice.
    """

    def __init__(self, denial: Denial) -> None:
        super().__init__(f"denied ({denial.reason}): {self.describe(denial)}")
        self.denial = denial

    @staticmethod
    def describe(denial: Denial) -> str:
        """Return a denial in one line.

        Args:
            denial: The denial.

        Returns:
            Its message, holder and advice.
        """
        name = denial.holder_name or denial.holder
        who = "" if not name or name in denial.message.replace(",", " ").split() else f"held by {name}"
        return join_parts(denial.message, who, denial.advice)


class RequestTimeoutError(ClientError, TimeoutError):
    """No answer came in time. The request may still take effect: check the leases before you ask again.

    Args:
        text: What was waited for, and for how long.
        denial: The session's answer to an `acquire` that was withdrawn.

    Attributes:
        denial: That answer, with the place in the queue and the holder; `None` for other requests.
    """

    def __init__(self, text: str, denial: Denial | None = None) -> None:
        super().__init__(text)
        self.denial = denial


class UnreachedError(ClientError, TimeoutError):
    """`move_to` did not reach its pose in time, or cannot reach it.

    Args:
        robot: Name of the robot.
        timeout_s: Time that it had [s].
        distance_m: See the attribute.
        angle_rad: See the attribute.
        feedback: The newest of the robot.
        why: What ended the motion before its time was up.
        rejected: `RejectReason`s of samples that were rejected meanwhile.

    Attributes:
        distance_m: Of the end effector from the pose [m], infinite when the robot was never driven.
        angle_rad: Of the end effector from the pose [rad].
        feedback: The newest of the robot: reason why it holds, or its active limits; `None` when none has come.
    """

    def __init__(
        self,
        robot: str,
        timeout_s: float,
        distance_m: float,
        angle_rad: float,
        feedback: Feedback | None,
        *,
        why: str = "",
        rejected: Sequence[str] = (),
    ) -> None:
        away = f"{1e3 * distance_m:.0f} mm and {math.degrees(angle_rad):.0f} degrees away"
        if math.isinf(distance_m):
            away = "" if why else "it was never driven"
        if feedback is None:
            report = "" if why else "the session has reported nothing about it: do you hold it?"
        elif feedback.hold_reason:
            reasons = ", ".join(rejected) if feedback.hold_reason == HoldReason.REJECTED else ""
            report = f"it holds: {feedback.hold_reason}" + (f" ({reasons})" if reasons else "")
            report = "" if why and not away else report
        else:
            report = f"its limits: {', '.join(feedback.limits)}" if feedback.limits else "give it more time"
        limits = () if feedback is None else feedback.limits
        advice = [text for limit, text in LIMIT_ADVICE.items() if limit in limits]
        within = "" if why else f" within {timeout_s:g} s"
        super().__init__(f"{robot} did not reach its pose{within}: {join_parts(away, why, report, *advice)}")
        self.distance_m, self.angle_rad, self.feedback = distance_m, angle_rad, feedback


class InvalidMessageError(ClientError, ValueError):
    """The message does not fit the protocol, or a value does not fit its field. Nothing was sent."""


class IdentityError(ClientError):
    """The identity file is unreadable, damaged, or readable by others."""


class TrustError(ClientError):
    """The session at an address is not the trusted one, or could not prove that it is. Nothing was sent to it."""


class SessionNameError(ClientError):
    """Several sessions have that name, or another one answered at its address."""


class AssetError(ClientError):
    """An asset could not be fetched.

    Args:
        address: Content hash.
        reason: See the attribute.
        text: The message.

    Attributes:
        address: Content hash; empty when the error concerns all assets.
        reason: An `AssetRefusal`, `hash` (the bytes did not match the hash twice), `protocol`, `decode`, `cache` (the
            folder of the cache cannot be used), `gone` (removed since), `no_channel`, `cancelled` or `closed`.
    """

    def __init__(self, address: str, reason: str, text: str) -> None:
        super().__init__(text)
        self.address = address
        self.reason = reason

    @classmethod
    def from_store(cls, error: AssetStoreError) -> AssetError:
        """Return the client's error for an error of its asset store.

        Args:
            error: The store's error.

        Returns:
            An error with the same address, reason and text.
        """
        return cls(error.address, error.reason, str(error))
