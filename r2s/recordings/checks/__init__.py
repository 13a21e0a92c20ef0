"""What is suspicious in a recording, each with the figure behind it.

- `seen`: the clouds that all of them look at.
- `sheet`: scale, gravity, stretch. `clock`: frames, lag, rate. `clouds`: points, outliers, crops.
"""

from r2s.recordings.checks.clock import check_clock
from r2s.recordings.checks.clouds import check_clouds
from r2s.recordings.checks.finding import Finding
from r2s.recordings.checks.seen import seen_in
from r2s.recordings.checks.sheet import check_sheet
from r2s.recordings.recording import Recording

__all__ = ["Finding", "check"]


def check(recording: Recording) -> list[Finding]:
    """All findings of a recording, the suspicious ones first."""
    seen = seen_in(recording)
    found = [*check_sheet(seen), *check_clock(seen), *check_clouds(seen)]
    return sorted(found, key=lambda each: not each.is_suspicious)
