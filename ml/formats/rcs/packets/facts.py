"""Facts of RC+S session folders: whose clock its times show, which counters turn, what is no reading, what changes the dose."""

from __future__ import annotations

from ml.formats.facts import ClockFact, DoseModifier, Facts
from ml.formats.facts.counters import Counter
from ml.formats.facts.sentinels import INT16, UINT8, UINT32, WIDE, Field

FACTS = Facts(
    clocks=(
        ClockFact("computer", "HostUnixTime, PacketGenTime, PacketRxUnixTime, UnixOnsetTime", "UTC, taken from it", "Summit API"),
        ClockFact("implant", "timestamp, systemTick", "differences alone are used", "recordings whose implant was years off"),
    ),
    counters={
        "systemTick": Counter(65_536, "100 us", True, "Summit API: 16 bits, 6.5536 s"),
        "dataTypeSequence": Counter(256, "packets of one stream", True, "Summit API: 8 bits"),
        "globalSequence": Counter(256, "packets of all streams", True, "Summit API: 8 bits"),
    },
    fields={
        "AmplitudeInMilliamps": Field("mA", 0, 25.4, (25.5, *WIDE), "Summit API: 255 x 0.1 mA means `hold`"),
        "Bands": Field("device units", 0, UINT32 - 1, (UINT32,), "Summit API: 32 bits"),
        "FftOutput": Field("mV", 0, 100, WIDE, "no electrode gives 100 mV"),
        "XSamples, YSamples, ZSamples": Field("centiG", -10_000, 10_000, (-32_768, INT16, *WIDE[:-1]), "no body reaches 100 g; 16 bits"),
        "output, featureInputs": Field("device units", 0, UINT32 - 1, (UINT32,), "Summit API: 32 bits"),
        "CurrentAdaptiveState": Field("state", 0, 8, (15,), "Summit API: 15 is no state"),
        "batteryLevelPercent": Field("%", 0, 100, (UINT8, *WIDE), "a share of 100"),
    },
    dose=(
        DoseModifier(
            "therapy off",
            "therapyStatus of StimLog and DeviceSettings",
            "0 mA; with a status other than off and on the amplitude is unknown",
            "Summit API",
        ),
        DoseModifier(
            "cycling",
            "cyclingEnabled, cycleOnTime, cycleOffTime of the active group",
            "the amplitude is unknown, and the report says the lengths where their unit is known",
            "a recording of 60 s on and 60 s off, whose unit code is 2",
        ),
        DoseModifier(
            "amplitude limits",
            "upper limit of each program of the active group",
            "a higher amplitude is unknown, and the report says why",
            "assumed: a device keeps to its limits",
        ),
        DoseModifier(
            "several programs",
            "isEnabled of each program of the active group",
            "one trace per program, and the report says so",
            "Summit API",
        ),
        DoseModifier("ramp", "rampTime, rampRepeat", "none: the unit is in no source", "recordings"),
    ),
)
