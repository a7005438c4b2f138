"""Numbers by which the daemon's own flights become a proposed airframe file (daemon/proposal.py)."""

from __future__ import annotations

from typing import Annotated

import msgspec

from nff_companion.core.tuning.span import span


class ProposalTuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is kept of flights for a proposed airframe file, and how long making it may take."""

    memory_s: Annotated[
        float,
        span(30.0, 600.0, "s", "of flight that is kept, the newest: three minutes are plenty (docs/calibration.md)"),
    ] = 180.0
    samples_max: Annotated[
        int, span(2000, 200000, "", "kept at most, whatever the rate: 92 bytes each with 8 motors, 3.3 MB at 200 Hz")
    ] = 72000
    patience_s: Annotated[
        float, span(10.0, 7200.0, "s", "after which a calibration that has not come to an end is given up")
    ] = 1800.0
