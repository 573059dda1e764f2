"""The loss that an event's final line tells, by the motion just before and after it: errors and stated deviations.

``python -m tests.statistics.early_loss N`` shakes the frame of three floors N times for each of four losses in story 2.
"""

from __future__ import annotations

import sys

import numpy as np

from tests.events.test_early_loss import final, shaken


def main(n: int) -> None:
    """Print what was told, in percent, of each story."""
    for lost in (0.0, 0.03, 0.1, 0.3):
        told = [final(shaken.__wrapped__(lost, 1000 + seed))[0] for seed in range(n)]
        error = np.array([event.loss for event in told]) - [0.0, lost, 0.0]
        std = np.array([event.loss_std for event in told])
        z = np.abs(error / std)
        rms, stated, beyond = (
            np.sqrt(np.nanmean(error**2, axis=0)),
            np.nanmedian(std, axis=0),
            np.nanmean(z > 2.0, axis=0),
        )
        exceeded = sum(bool(event.exceeded) for event in told)
        right = sum(
            int(np.nanargmax(event.loss / event.loss_std)) == 1 for event in told if np.isfinite(event.loss).any()
        )
        print(
            f"{100 * lost:.0f} % lost: errors {np.round(100 * rms, 1)} %, stated {np.round(100 * stated, 1)} %, beyond two "
            f"deviations {np.round(100 * beyond)} %, null {int(np.isnan(error).sum())}, limit of 5 % exceeded {exceeded}, "
            f"story 2 the most significant {right}, of {n}",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]))
