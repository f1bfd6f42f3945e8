"""Errors of the simulated studio.

::

    AdapterError
    └── SimulatorError      a lens file, fault or option that the studio cannot run with

Each message is one line: what, where, what to do.
"""

from __future__ import annotations

from engine_adapters.errors import AdapterError


class SimulatorError(AdapterError):
    """A lens file, fault specification or option that the simulated studio cannot run with."""
