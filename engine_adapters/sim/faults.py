"""Faults on demand, the same in every run: which exchange of which server goes wrong, and how.

A specification is ``TARGET:KIND[=VALUE]@WHICH``. TARGET: ``r3`` or ``mockboard``. WHICH: the number of the exchange
(counted from 1 over all connections of the server), a range ``4..6``, or ``*`` for each one. KIND:

- ``drop``: the request is read and never answered;
- ``late=SECONDS``: the answer comes that much later;
- ``split``: the answer comes in small pieces;
- ``garbage``: nonsense instead of the answer;
- ``clip=LIMIT`` (r3): k1 and k2 set in it are kept within -LIMIT and LIMIT, though the answer says they were set;
- ``disconnect``: the first half of the answer, then the connection is closed;
- ``stale`` (mockboard): the picture of the exchange before once more;
- ``status=CODE`` (mockboard): an HTTP error.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from engine_adapters.sim.errors import SimulatorError


class FaultTarget(StrEnum):
    """The server that misbehaves."""

    R3 = "r3"
    MOCKBOARD = "mockboard"


class FaultKind(StrEnum):
    """What goes wrong."""

    DROP = "drop"
    LATE = "late"
    SPLIT = "split"
    CLIP = "clip"
    GARBAGE = "garbage"
    DISCONNECT = "disconnect"
    STALE = "stale"
    STATUS = "status"


_WITH_VALUE = {FaultKind.LATE: (0.0, 600.0), FaultKind.STATUS: (400, 599), FaultKind.CLIP: (0.0, 1e6)}
_ONE_SERVER = {
    FaultKind.STALE: FaultTarget.MOCKBOARD,
    FaultKind.STATUS: FaultTarget.MOCKBOARD,
    FaultKind.CLIP: FaultTarget.R3,
}
_SPEC = re.compile(
    r"(?P<target>[a-z0-9]+):(?P<kind>[a-z]+)(=(?P<value>[^@]+))?@(?P<which>\*|[0-9]{1,9}(\.\.[0-9]{1,9})?)"
)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault: ``value`` in seconds (late) or an HTTP status; exchanges ``first`` to ``last`` (None: for ever)."""

    target: FaultTarget
    kind: FaultKind
    first: int
    last: int | None
    value: float = 0.0

    def hits(self, exchange: int) -> bool:
        """Whether it strikes that exchange (from 1)."""
        return self.first <= exchange and (self.last is None or exchange <= self.last)


def parse_fault(spec: str) -> Fault:
    """Read a specification. Raises :class:`SimulatorError` with one line."""
    where = f"fault {spec[:80]!r}"
    match = _SPEC.fullmatch(spec)
    if match is None:
        raise SimulatorError("write it as TARGET:KIND[=VALUE]@WHICH, for example r3:late=0.5@3", where=where)
    try:
        target = FaultTarget(match["target"])
    except ValueError as error:
        raise SimulatorError(
            f"no server is called {match['target']}; there are r3 and mockboard", where=where
        ) from error
    try:
        kind = FaultKind(match["kind"])
    except ValueError as error:
        known = ", ".join(FaultKind)
        raise SimulatorError(f"no fault is called {match['kind']}; there are {known}", where=where) from error
    if _ONE_SERVER.get(kind, target) is not target:
        raise SimulatorError(f"{kind} is a fault of the {_ONE_SERVER[kind]} only", where=where)
    value = _value(kind, match["value"], where)
    if match["which"] == "*":
        return Fault(target, kind, 1, None, value)
    first, _, last = match["which"].partition("..")
    begin, end = int(first), int(last or first)
    if begin < 1 or end < begin:
        raise SimulatorError("exchanges are counted from 1, and a range goes upwards", where=where)
    return Fault(target, kind, begin, end, value)


def _value(kind: FaultKind, text: str | None, where: str) -> float:
    if kind not in _WITH_VALUE:
        if text is not None:
            raise SimulatorError(f"{kind} takes no value", where=where)
        return 0.0
    low, high = _WITH_VALUE[kind]
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not low <= value <= high or (kind is FaultKind.STATUS and value % 1):
        raise SimulatorError(f"{kind} needs a value from {low:g} to {high:g}, as in {kind}={low or 0.5:g}", where=where)
    return value


class FaultPlan:
    """Counts each server's exchanges and tells which fault strikes."""

    def __init__(self, faults: Iterable[Fault] = ()) -> None:
        self._faults = tuple(faults)
        self._exchanges = dict.fromkeys(FaultTarget, 0)

    def next(self, target: FaultTarget) -> Fault | None:
        """Count one exchange of the server; the first fault listed for it, if any."""
        self._exchanges[target] += 1
        number = self._exchanges[target]
        return next((fault for fault in self._faults if fault.target is target and fault.hits(number)), None)
