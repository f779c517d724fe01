#!/bin/sh
# BrainFlow 5.23.0: the window that is chosen for a spectrum changes the power that comes out, up to fourfold.
#
# `DataFilter.get_psd` and `get_psd_welch` multiply the samples by the window and divide by the sampling rate and the number of samples.
# The power that the window takes away is never given back. Without a window a sine of 2 µV has its true 2 µV² in the beta band.
# With a Hanning window it has 0.75, with Hamming 0.79 and with Blackman-Harris 0.51 µV². The factor is the mean square of the window.
# White noise shrinks by the same factor. SciPy's `welch` gives 2 µV² with every one of these windows.
#
# The documentation calls the result a PSD and says nothing about the window's gain. A threshold for beta that was set with one window, or
# with another library, is wrong by that factor. Ratios of two bands under one window are right.
#
# Prints the beta power of the same sine per window, and fails where the values are others than were seen: 2.00, 0.75, 0.79, 0.51.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check brainflow==5.23.0 numpy==2.4.6 scipy==1.17.1
cat >"$folder/windows.py" <<'PYTHON'
import numpy as np
from brainflow.data_filter import DataFilter, WindowOperations
from scipy.signal import welch

RATE_HZ, LENGTH = 256, 512
BETA_HZ = (13.0, 30.0)
WINDOWS = {"NO_WINDOW": "boxcar", "HANNING": "hann", "HAMMING": "hamming", "BLACKMAN_HARRIS": "blackmanharris"}

seconds = np.arange(20 * RATE_HZ) / RATE_HZ
microvolts = 2.0 * np.sin(2 * np.pi * 20 * seconds)

found = []
for name, scipy_name in WINDOWS.items():
    psd = DataFilter.get_psd_welch(microvolts.copy(), LENGTH, LENGTH // 2, RATE_HZ, WindowOperations[name])
    power = DataFilter.get_band_power(psd, *BETA_HZ)
    frequency, density = welch(microvolts, RATE_HZ, scipy_name, LENGTH)
    within = (frequency >= BETA_HZ[0]) & (frequency <= BETA_HZ[1])
    print(f"{name}: {power:.3f} µV² (SciPy {np.trapezoid(density[within], frequency[within]):.3f}, true 2)")
    found.append(round(power, 2))
raise SystemExit(found != [2.0, 0.75, 0.79, 0.51])
PYTHON
"$folder/venv/bin/python" "$folder/windows.py"
