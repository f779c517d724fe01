"""Facts of Percept session reports: whose clock its dates show, which counters turn, what is no reading, what changes the dose."""

from __future__ import annotations

from ml.formats.facts import ClockFact, DoseModifier, Facts
from ml.formats.facts.counters import Counter
from ml.formats.facts.sentinels import UINT8, WIDE, Field

_TURN_MS = 65_536 * 50.0
_INTEGER = "largest value of an integer of 16 or 32 bits, or -1"

POWER = Field("device units", 0, 2**31 - 2, WIDE, f"2^32-1 in public reports; {_INTEGER}")
AMPLITUDE = Field("mA", 0, 25.4, (25.5, *WIDE), "8 bits of 0.1 mA, of which 255 is no amplitude")
IMPEDANCE = Field("ohm", 0, 1e6, WIDE, _INTEGER)
MAGNITUDE = Field("uVp", 0, 1e5, WIDE, f"no electrode gives 100 mV; {_INTEGER}")
BATTERY_PERCENT = Field("%", 0, 100, (UINT8, *WIDE), "a share of 100")
BATTERY_MONTHS = Field("months", 0, 254, (UINT8, *WIDE), "8 bits; no battery lasts 21 years")
RATE = Field("Hz", 0, 500, WIDE, f"no stimulator gives more; {_INTEGER}")
PULSE_WIDTH = Field("us", 0, 1000, WIDE, f"no stimulator gives longer pulses; {_INTEGER}")
BAND = Field("Hz", 0, 125, WIDE, f"half of the rate of the samples; {_INTEGER}")
AVERAGING = Field("ms", 0, 3.6e6, WIDE, f"no longer than an hour; {_INTEGER}")

FACTS = Facts(
    clocks=(
        ClockFact(
            "programmer",
            "SessionDate, SessionEndDate",
            "UTC, taken from the tablet",
            "13 public reports of 6 implants: these two alone agree with the tablet",
        ),
        ClockFact(
            "implant",
            "every other date, such as FirstPacketDateTime, DateTime, DeviceDateTime",
            "DeviceDateTime - SessionDate at begin, DeviceDateTime - SessionEndDate at end",
            "the same reports: 4.5 to 37.6 min ahead",
        ),
    ),
    counters={
        "TicksInMses": Counter(_TURN_MS, "ms", False, "two public reports of 2024: it runs on beyond 2^16 x 50 ms"),
        "TicksInMs": Counter(_TURN_MS, "ms", True, "the same reports: 18 of 24 runs count modulo 2^16 x 50 ms"),
        "GlobalSequences": Counter(256, "packets", True, "8 bits; loss is seen by ticks, and this counter is not used"),
    },
    fields={
        "LFP": POWER,
        "mA, AmplitudeInMilliAmps, LowerLimitInMilliAmps, UpperLimitInMilliAmps": AMPLITUDE,
        "LowerLfpThreshold, UpperLfpThreshold": POWER,
        "RateInHertz": RATE,
        "PulseWidthInMicroSecond": PULSE_WIDTH,
        "FrequencyInHertz, PeakFrequencyInHertz, HighPassFilterInHertz": BAND,
        "AveragingDurationInMilliSeconds": AVERAGING,
        "ResultValue": IMPEDANCE,
        "FFTBinData, LFPMagnitude": MAGNITUDE,
        "BatteryPercentage": BATTERY_PERCENT,
        "EstimatedBatteryLifeMonths": BATTERY_MONTHS,
    },
    dose=(
        DoseModifier(
            "cycling",
            "Groups: GroupSettings.Cycling.Enabled of the run's group",
            "the amplitude of the run is unknown, and the report says why",
            "a real report has the field in every group",
        ),
        DoseModifier(
            "soft start",
            "Groups: GroupSettings.SoftStartStop",
            "none: LfpData has the amplitude that was reached, twice a second",
            "a real report: 4 s",
        ),
        DoseModifier("therapy off", "LfpData.mA", "none: LfpData then has 0 mA", "runs without stimulation of a real report"),
    ),
)
