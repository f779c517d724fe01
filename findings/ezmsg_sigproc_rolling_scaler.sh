#!/bin/sh
# ezmsg-sigproc 3.11.1 with ezmsg 3.10.0b5: one missing sample sets a rolling z-score to 0 for ever, and its window grows with the messages.
#
# `RollingScalerProcessor` turns a stream, for example beta power, into z-scores against its last `window_size` seconds or `k_samples` samples.
#
# One NaN, which is how a lost packet is marked, enters the running mean and never leaves it: not even after the window has passed.
# Each later z-score is then not a number, and the last step replaces that by 0. The output looks like a signal at its mean, without NaN,
# and a controller that stimulates above a threshold stimulates no more. No warning is raised.
#
# The window counts messages, not samples. With messages of 10 samples a window of 5 s spans 50 s. The same signal is judged otherwise when
# only the size of the packets changes. The z-score 10 s after a lasting rise should be about 0 again and is 1.5. `window_size` is documented
# as seconds and `k_samples` as a number of samples. The library's own test of `k_samples` counts messages.
#
# Prints both, and fails where they are others than were seen.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ezmsg-sigproc==3.11.1 ezmsg==3.10.0b5 ezmsg-baseproc==1.15.0 numpy==2.4.6
cat >"$folder/scaler.py" <<'PYTHON'
import numpy as np
from ezmsg.sigproc.rollingscaler import RollingScalerProcessor, RollingScalerSettings
from ezmsg.util.messages.axisarray import AxisArray

RATE_HZ, WINDOW_S = 100, 5.0


def z_scores(signal: np.ndarray, samples_per_message: int) -> np.ndarray:
    """Return the z-scores of a signal that is sent in messages of this size."""
    scaler = RollingScalerProcessor(RollingScalerSettings(window_size=WINDOW_S, update_with_signal=True, clip=None))
    parts = []
    for first in range(0, len(signal), samples_per_message):
        axis = AxisArray.TimeAxis(fs=RATE_HZ, offset=first / RATE_HZ)
        part = signal[first : first + samples_per_message, None]
        parts.append(scaler(AxisArray(part, dims=["time", "ch"], axes={"time": axis})).data[:, 0])
    return np.concatenate(parts)


noise = np.random.default_rng(0).standard_normal(60 * RATE_HZ)

risen = noise.copy()
risen[30 * RATE_HZ :] += 5  # a lasting rise at 30 s, forgotten after 5 s
later = []
for size in (1, 10, 50):
    later.append(round(float(z_scores(risen, size)[40 * RATE_HZ : 42 * RATE_HZ].mean()), 1))
    print(f"messages of {size} samples: mean z-score 10 s after a lasting rise is {later[-1]} (window of {WINDOW_S:g} s, true 0)")

missing = noise.copy()
missing[20 * RATE_HZ] = np.nan
missing[50 * RATE_HZ :] += 5  # a rise of five standard deviations, half a minute after the gap
after = z_scores(missing, 1)[21 * RATE_HZ :]
print(f"after one NaN at 20 s: {np.isnan(after).sum()} NaN, largest |z| in the next 39 s {np.abs(after).max():g} (true above 5)")
raise SystemExit((later, float(np.abs(after).max())) != ([0.0, 1.5, 1.5], 0.0))
PYTHON
"$folder/venv/bin/python" "$folder/scaler.py"
