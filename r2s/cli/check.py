"""`r2s check`: what is suspicious in a recording, before anything is estimated from it."""

from dataclasses import dataclass

from r2s.cli.common import Json, RecordingPath


@dataclass(frozen=True)
class Check:
    """Say what is suspicious in a recording, each with the figure behind it.

    Looks at the scale, gravity and table where the whole sheet is seen at rest, at how far points
    are from the grippers, whether markers or the whole sheet stretch, the frames' times, how late
    the top of the cloud follows the grippers, the number of points, outliers, and crops. What a
    recording does not show is said to be not shown. Exit code 1 when something is suspicious.

        r2s check recordings/lift_tan
        r2s check lift.npz --json
    """

    recording: RecordingPath
    json: Json = False

    def run(self) -> int:
        from r2s.cli.common import print_result
        from r2s.recordings.checks import check
        from r2s.recordings.open import open_recording

        found = check(open_recording(self.recording))
        suspicious = sum(each.is_suspicious for each in found)
        content = {"suspicious": suspicious, "findings": [each._asdict() for each in found]}
        total = f"{suspicious} of {len(found)} suspicious" if suspicious else "nothing suspicious"
        print_result(self.json, content, [*(each.describe() for each in found), total])
        return int(suspicious > 0)
