#!/bin/sh
# pdkit 1.4.4: tremor is judged from the middle 2.56 s of a recording, and a limping hand has a perfect score of coordination.
#
# `TremorProcessor.amplitude` with its default method "fft" keeps `window` samples (256, at 100 Hz) around the middle of the recording and
# drops the rest. The documentation calls `window` just "window (256)". A 30 s recording with tremor throughout, except for the middle 2.8 s,
# has the amplitude 0.0003 where tremor throughout has 0.51. Tremor during these 2.8 s only has 0.51 as well.
# Rest tremor of Parkinson's disease comes and goes within seconds, so one and the same minute is judged "none" or "full" by chance.
# The method "welch" uses the whole recording. `bradykinesia` with its default method has the same fault.
#
# `FingerTappingProcessor.incoordination_score` is documented as the variance of the interval between taps in msec. It takes every second
# interval, so a hand that alternates between movements of 100 and 900 ms scores 0. It multiplies the variance in s² by 1000 instead of
# 1 000 000. Two short and two long movements in turn have a variance of 160 000 ms² and score 160.
#
# Prints both, and fails where the numbers are others than were seen.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
pip() { "$folder/venv/bin/pip" install --quiet --disable-pip-version-check "$@"; }
pip numpy==1.23.5 pandas==1.5.3 scipy==1.11.4 tsfresh==0.20.2 future==1.0.0 soundfile==0.14.0 praat-parselmouth==0.4.7 \
    pandas-validator==0.5.0 setuptools==65.5.0 scikit-learn==1.2.2 PyWavelets==1.8.0 matplotlib==3.10.9
pip --no-deps pdkit==1.4.4
cat >"$folder/judged.py" <<'PYTHON'
import sys

import numpy as np
import pandas as pd
import pdkit

RATE_HZ, TREMOR_HZ, SECONDS = 99, 5, 30  # a telephone's 100 Hz sensor seldom keeps its rate

seconds = np.arange(SECONDS * RATE_HZ) / RATE_HZ
tremor = np.sin(2 * np.pi * TREMOR_HZ * seconds)
middle = np.abs(seconds - SECONDS / 2) < 1.4
hands = {"throughout": tremor, "except for the middle": np.where(middle, 0, tremor), "in the middle only": np.where(middle, tremor, 0)}

amplitudes = []
for name, hand in hands.items():
    np.savetxt(sys.argv[1], np.column_stack([seconds * 1e9, 0 * hand, 0 * hand, 9.81 + hand]), delimiter=",")
    recording = pdkit.TremorTimeSeries().load(sys.argv[1])
    processor = pdkit.TremorProcessor()
    by_fft, by_welch = processor.amplitude(recording)[0], processor.amplitude(recording, "welch")[0]
    print(f"tremor {name}: amplitude {by_fft:.4f} by fft (the default), {by_welch:.3f} by welch")
    amplitudes.append(round(by_fft, 2))


def incoordination(moves_s: np.ndarray) -> float:
    """Return the score of taps of 100 ms with these movements between them."""
    down = np.concatenate([[0], np.cumsum(moves_s + 0.1)])
    td = np.sort(np.concatenate([down, down + 0.1]))
    taps = pd.DataFrame({"td": td, "action_type": np.tile([0, 1], len(down)), "x": 0, "y": 0}, index=pd.to_datetime((td * 1e9).astype("int64")))
    return pdkit.FingerTappingProcessor().incoordination_score(taps)[0]


limping, paired = np.tile([0.1, 0.9], 30), np.tile([0.1, 0.1, 0.9, 0.9], 15)
scores = [incoordination(moves) for moves in (limping, paired)]
for name, moves, score in zip(("limping", "paired"), (limping, paired), scores, strict=True):
    print(f"{name} movements: variance {np.var(moves * 1000):.0f} ms², score {score:.1f}")
raise SystemExit((amplitudes, [round(score) for score in scores]) != ([0.51, 0.0, 0.51], [0, 160]))
PYTHON
"$folder/venv/bin/python" -W ignore "$folder/judged.py" "$folder/hand.csv"
