#!/bin/sh
# ezmsg-sigproc 3.11.1 with ezmsg 3.10.0b5: zero-padding a spectrum moves its frequencies, so that 20 Hz is reported as 40 Hz.
#
# `SpectrumTransformer` accepts `nfft`, the number of points of the Fourier transform. When `nfft` exceeds the samples of the window, the
# window is padded with zeros, which leaves every peak where it was. The frequency axis is computed as if padding slowed the sampling:
# each frequency is multiplied by `nfft` divided by the samples. A window of 1 s at 250 Hz with `nfft=500` ends at 250 Hz, which is twice
# what such a recording can hold.
#
# In closed-loop stimulation short windows are padded to a power of two. With `nfft=512` a 20 Hz rhythm leaves the beta band (13 to 30 Hz)
# wholly. A rhythm at 9 Hz is reported as 18 Hz, within that band. No error or warning is raised.
#
# Prints the reported peak and the share of power in the beta band, and fails where they are others than were seen.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ezmsg-sigproc==3.11.1 ezmsg==3.10.0b5 ezmsg-baseproc==1.15.0
cat >"$folder/padding.py" <<'PYTHON'
import numpy as np
from ezmsg.sigproc.spectrum import SpectralTransform, SpectrumSettings, SpectrumTransformer
from ezmsg.util.messages.axisarray import AxisArray

RATE_HZ = 250
BETA_HZ = (13.0, 30.0)


def peak_and_beta(tone_hz: float, nfft: int | None) -> tuple[float, float]:
    """Return the reported peak in Hz and the beta band's share of power, for one second of a tone."""
    tone = np.sin(2 * np.pi * tone_hz * np.arange(RATE_HZ) / RATE_HZ)
    message = AxisArray(tone[:, None], dims=["time", "ch"], axes={"time": AxisArray.TimeAxis(fs=RATE_HZ)})
    settings = SpectrumSettings(axis="time", nfft=nfft, transform=SpectralTransform.REL_POWER)
    spectrum = SpectrumTransformer(settings)(message)
    power, axis = spectrum.data[:, 0], spectrum.axes["freq"]
    frequency = axis.offset + axis.gain * np.arange(len(power))
    within = (frequency >= BETA_HZ[0]) & (frequency <= BETA_HZ[1])
    return float(frequency[np.argmax(power)]), float(power[within].sum() / power.sum())


found = []
for tone_hz, nfft in [(20, None), (20, 250), (20, 500), (20, 512), (20, 1000), (9, None), (9, 512)]:
    peak_hz, beta = peak_and_beta(tone_hz, nfft)
    print(f"tone of {tone_hz} Hz, nfft {nfft}: peak reported at {peak_hz:g} Hz, {beta:.0%} of the power within 13 to 30 Hz")
    found.append((round(peak_hz), round(beta, 1)))
raise SystemExit(found != [(20, 1.0), (20, 1.0), (40, 0.0), (41, 0.0), (80, 0.0), (9, 0.0), (18, 1.0)])
PYTHON
"$folder/venv/bin/python" "$folder/padding.py"
