"""Camera heads: a person, the simulated studio's, and later VISCA."""

from __future__ import annotations

from engine_adapters.head.operator import AskOperator, OperatorHead
from engine_adapters.head.simulated import SimulatedHead
from engine_adapters.ports import CameraHead
from engine_adapters.profile import VISCA_NOT_AVAILABLE, HeadSettings, ProfileError

__all__ = ["AskOperator", "OperatorHead", "SimulatedHead", "build_head"]


def build_head(settings: HeadSettings, *, ask: AskOperator) -> CameraHead:
    """The head that a profile names. ``ask`` reaches the operator. Raises ``ProfileError`` for VISCA."""
    match settings.kind:
        case "operator":
            return OperatorHead(ask, answer_timeout_s=settings.answer_timeout_s)
        case "simulated":
            return SimulatedHead(settings)
        case "visca":
            raise ProfileError(VISCA_NOT_AVAILABLE, where="studio profile")
