"""First record of a Summit RC+S settings file: record 0 of DeviceSettings and StimLog for a synthetic participant.

Field names, codes and units as in recordings of the device. Identity fields state that there is no person behind them.
"""

from __future__ import annotations

import math
from typing import Any, Final

from ml.population.participants import ParticipantModel, Programme

Json = dict[str, Any]

TRIM: Final = 236  # factory gain trim of the sensing amplifiers, as read from real devices
GAIN: Final = 250.0 * TRIM / 255.0
COUNTS_PER_VOLT: Final = 48644.8683623726
"""Device units u = mV * GAIN * COUNTS_PER_VOLT / 1200; one unit is the resolution of the converter."""
FFT_SIZE, FFT_SAMPLES = 256, 250  # 250 samples, zero padded to 256
FFT_SIZE_CODE, FFT_INTERVAL_MS = 1, 500
BAND_FORMATION: Final = 8  # bit shift 15 - 8 = 7: the power is divided by 2^(8 - 7)
POWER_BANDS: Final = ((14, 35), (20, 30))
"""First and last FFT bin of the two bands of channel 0; a bin is 250 / 256 Hz wide: 13.2-34.7 Hz and 19.0-29.8 Hz."""
VALID_MASK: Final = 3
RATE_CODE: Final = 0  # 250 Hz
PACKET_SAMPLES: Final = 25
_PLACEHOLDER_TENTHS: Final = 85  # disabled programs keep 8.5 mA and 850 us in real files


def device_settings(participant: ParticipantModel, serial: str, ins_seconds: int) -> Json:
    """Record 0 of DeviceSettings, without RecordInfo: all sections, sensing on, streams off."""
    return {
        "UtcOffset": 0,
        "FirmwareID": _firmware(),
        "GeneralData": general_data(serial, ins_seconds, therapy_on=True),
        "OorData": {
            "caseOorStatus": 0,
            "programData": [{"currentStackData": {"currentStackType": 0, "oorMaxStack": False}, "regulatorOor": 0} for _ in range(4)],
            "type": 2,
        },
        "BatteryStatus": {
            "batteryLevelPercent": 80,
            "batterySOC": 70,
            "batteryVoltage": 2430,
            "estimatedCapacity": 79,
            "fullSOC": 79,
            "manufacturedCapacity": 79,
            "socUncertainty": 0,
            "therapyUnavailableSOC": 6,
        },
        "FlashFormatHeader": _flash_header(),
        "SubjectInfo": _subject(participant),
        "LastPtmRtmInfo": {
            "CrcValid": True,
            "DataCrc": [0, 0],
            "PtmAppVersion": [3, 2],
            "PtmCompatabilityId": [0, 1],
            "PtmSerialNumber": "SYNTHETIC0",
            "RtmAppVersion": [1, 1],
            "RtmCompatabilityId": [0, 1],
            "RtmSerialNumber": "SYNTHETIC0",
        },
        "SensingConfig": _sensing(participant.programme),
        "DetectionConfig": {"Ld0": _detector(), "Ld1": _detector(), "Valids": 31},
        "SenseState": {"accelRate": 255, "fftStreamChannel": 0, "state": 7},
        "StreamState": stream_state(on=False),
        **{f"TherapyConfigGroup{n}": therapy_group(participant, n, participant.cdbs_amplitude_ma) for n in range(4)},
        "AdaptiveConfig": _adaptive(),
        "TelemetryModuleInfo": {
            "BatteryLevel": 100,
            "BatteryStatus": "Ok",
            "BeepEnables": 0,
            "FirmwareVersion": 2645,
            "IsConnected": True,
            "ModuleType": "Ctm2",
            "PhysicalLayer": 3,
            "SerialNumber": "SYNTHETIC0  ",
            "TelmMode": "MMode4",
            "TelmRatio": 4,
            "WireType": "WirelessConnection",
        },
        "FactorySettings": _factory_settings(),
        **{f"AmplitudeLimitsGroup{n}": _limits(participant.cdbs_amplitude_ma if n == 0 else None) for n in range(4)},
    }


def general_data(serial: str, ins_seconds: int, *, therapy_on: bool) -> Json:
    """Make section GeneralData, which later records repeat."""
    return {
        "batteryStatus": 80,
        "daysUntilEos": 3254,
        "deviceSerialNumber": [ord(letter) for letter in serial],
        "deviceTime": {"seconds": ins_seconds},
        "hybridSerialNumber": [0, 0, 0, 0, 0, 0],
        "implantDate": {"seconds": 0},
        "isEos": False,
        "isEri": False,
        "isInCPSession": False,
        "isMriModeOn": False,
        "isOvervoltage": False,
        "isTherapyUnavailable": False,
        "telMDeviceId": [0, 0, 0, 0, 0, 0],
        "therapyStatusData": {"activeGroup": 0, "therapyStatus": int(therapy_on)},
        "type": 1,
    }


def stream_state(*, on: bool) -> Json:
    """Make section StreamState: time domain, power and time sync together."""
    return {
        "AccelStreamEnabled": False,
        "AdaptiveStreamEnabled": False,
        "DetectionStreamEnabled": False,
        "FftStreamEnabled": False,
        "LoopRecordMarkerEchoStreamEnabled": False,
        "PowerDomainStreamEnabled": on,
        "StreamsEnabled": on,
        "TimeDomainStreamEnabled": on,
        "TimeSyncStreamEnabled": on,
    }


def therapy_group(participant: ParticipantModel, group: int, amplitude_ma: float) -> Json:
    """Make section TherapyConfigGroup of DeviceSettings: group A (0) has the programme, the others are unused."""
    p = participant.programme
    used = group == 0
    period = round(1e5 / p.rate_hz) if used else 21845
    width = p.pulse_width_us // 10 if used else _PLACEHOLDER_TENTHS
    rate = p.rate_hz if used else 4.6
    return {
        "Index": 0 if used else 80,
        "amplitudeResolution0_2mA": 0 if used else 85,
        "cycleOffTime": {"time": 10 if used else 5461, "units": int(not used)},
        "cycleOnTime": {"time": 10 if used else 5461, "units": int(not used)},
        "cyclingEnabled": False,
        "mode": 1,
        "programs": [_program(p, n, amplitude_ma if used and n == 0 else None) for n in range(4)],
        "pulseWidthLowerLimit": width,
        "pulseWidthLowerLimitInMicroseconds": 10 * width,
        "pulseWidthUpperLimit": width,
        "pulseWidthUpperLimitInMicroseconds": 10 * width,
        "rampRepeat": 0,
        "rampTime": 0,
        "rateInHz": rate,
        "rateLowerLimitInHz": 2 if used else 4.6,
        "ratePeriod": period,
        "ratePeriodLowerLimit": period,
        "ratePeriodUpperLimit": 50000 if used else period,
        "rateUpperLimitInHz": rate,
        "reserved1": 0,
        "reserved2": 0,
        "reserved3": 0,
        "valid": used,
    }


def stim_group(participant: ParticipantModel, group: int, amplitude_ma: float) -> Json:
    """Make section TherapyConfigGroup of StimLog, which spells its fields in another way."""
    p = participant.programme
    out: Json = {"ratePeriod": round(1e5 / p.rate_hz) if group == 0 else 21845, "RateInHz": p.rate_hz if group == 0 else 4.6}
    for n in range(4):
        used = group == 0 and n == 0
        width = p.pulse_width_us // 10 if used else _PLACEHOLDER_TENTHS
        out[f"program{n}"] = stim_amplitude(amplitude_ma if used else _PLACEHOLDER_TENTHS / 10) | {
            "pulseWidth": width,
            "PulseWidthInMicroseconds": 10 * width,
        }
    return out


def stim_amplitude(amplitude_ma: float) -> Json:
    """Make the amplitude of one program in StimLog: tenths of mA and mA."""
    tenths = round(10 * amplitude_ma)
    return {"amplitude": tenths, "AmplitudeInMilliamps": tenths / 10}


def _program(programme: Programme, index: int, amplitude_ma: float | None) -> Json:
    used = amplitude_ma is not None
    tenths = round(10 * amplitude_ma) if amplitude_ma is not None else _PLACEHOLDER_TENTHS
    width = programme.pulse_width_us // 10 if used else _PLACEHOLDER_TENTHS
    electrodes = [
        {
            "elecValue": 63 if used else 21,
            "electrodeType": 0 if used and contact in programme.cathodes else 1,
            "isOff": used and contact not in programme.cathodes + programme.anodes,
            "reserved1": int(used),
        }
        for contact in range(17)
    ]
    return {
        "amplitude": tenths,
        "amplitudeInMilliamps": tenths / 10,
        "electrodes": {"electrodes": electrodes},
        "isEnabled": 0 if used else 131,
        "miscSettings": {"activeRechargeRatio": 10 if used else 0, "cyclingEnable": False, "unused": 0, "unused2": 0},
        "pulseWidth": width,
        "pulseWidthInMicroseconds": 10 * width,
        "reserved": [0] * 8,
        "reservedRateMult": 1 if used else 85,
        "subvalid": used,
        "valid": used,
    }


def _limits(upper_ma: float | None) -> Json:
    """Make the clinician's limits of a group: program 0 up to the cDBS amplitude; placeholders where the group is unused."""
    out: Json = {}
    for n in range(4):
        tenths = _PLACEHOLDER_TENTHS if upper_ma is None else round(10 * upper_ma) if n == 0 else 0
        lower = _PLACEHOLDER_TENTHS if upper_ma is None else 0
        out |= {f"prog{n}Lower": lower, f"prog{n}LowerInMilliamps": lower / 10}
        out |= {f"prog{n}Upper": tenths, f"prog{n}UpperInMilliamps": tenths / 10}
    return out


def _sensing(programme: Programme) -> Json:
    channel = {"currentMode": 1, "evokedMode": 0, "gain": 2, "hpf": 0, "lpf1": 9, "lpf2": 9, "outputMode": 1}
    used = {"minusInput": 1 << programme.sense_minus, "plusInput": 1 << programme.sense_plus, "sampleRate": RATE_CODE}
    unused = {"minusInput": 1, "plusInput": 4, "sampleRate": 240}
    (low, high), (low_1, high_1) = POWER_BANDS
    bands = {"band0Start": low, "band0Stop": high, "band1Start": low_1, "band1Stop": high_1}
    return {
        "bandEnable": VALID_MASK,
        "chopClockSettings": {"ChopClockSettings": [20] * 13},
        "fftConfig": {
            "bandFormationConfig": BAND_FORMATION,
            "config": 159,
            "interval": FFT_INTERVAL_MS,
            "size": FFT_SIZE_CODE,
            "streamOffsetBins": 0,
            "streamSizeBins": 0,
            "windowLoad": 2,
        },
        "miscSensing": {
            "Unused1": 0,
            "Unused2": 0,
            "bridging": 0,
            "lrPostBufferTime": 53,
            "lrTriggers": 1,
            "reserved0": 0,
            "reserved1": 0,
            "streamingRate": 10,
        },
        "powerChannels": [bands] + [{"band0Start": 13, "band0Stop": 14, "band1Start": 13, "band1Stop": 14}] * 3,
        "senseBlanking": {"blankingExtensionTime": 102, "l380BlankEnableRegisterMode": 1},
        "timeDomainChannels": [channel | used] + [channel | unused] * 3,
        "Valids": 31,
    }


def _subject(participant: ParticipantModel) -> Json:
    nowhere = {"TargetCoordinate1": math.nan, "TargetCoordinate2": math.nan, "TargetCoordinate3": math.nan, "TheCoordinateType": 3}
    left = participant.hemisphere == "left"
    return {
        "BirthDateUnixTime": 0,
        "ClinicianNotes": "Synthetic recording. There is no such person.",
        "CrcValid": True,
        "DataCRC": 0,
        "Diagnosis": "Synthetic",
        "DiagnosisDateUnixTime": 0,
        "DisableAnnotationEnforcement": True,
        "Extensions": [2, 2],
        "GroupAdjustSettings": [585, 585, 585, 0],
        "Handedness": 1,
        "ID": f"SYNTHETIC-{participant.code}",
        "ImplantedLeads": [2, 2, 2, 2],
        "InsImplantLocation": 2,
        "LeadLocation": [1 if left else 2] * 2 + [2 if left else 1] * 2,
        "LeadTargets": ["STN", "GPi", "", ""],
        "ProgramNames": ["STN"] + [""] * 15,
        "PtmSummitSettings": 0,
        "RlpToPtmSubBlockVersion": 256,
        "Sex": 0,
        "SubjectDataFormat": 256,
        "SymptomOnsetDateUnixTime": 0,
        "TargetCoordinates": [nowhere] * 4,
    }


def _detector() -> Json:
    return {
        "biasTerm": [0, 0],
        "blankingDurationUponStateChange": 0,
        "detectionEnable": 0,
        "detectionInputs": 0,
        "features": [{"normalizationMultiplyVector": 0, "normalizationSubtractVector": 0, "weightVector": 0}] * 4,
        "fractionalFixedPointValue": 0,
        "holdoffTime": 0,
        "onsetDuration": 0,
        "terminationDuration": 0,
        "updateRate": 0,
    }


def _adaptive() -> Json:
    hold: Json = {"isValid": False}
    for n in range(4):
        hold |= {f"prog{n}Amp": 255, f"prog{n}AmpInMilliamps": 25.5}
    hold |= {"rateTarget": 769, "rateTargetInHz": 130}
    return {
        "adaptiveMode": 0,
        "adaptiveStatus": 0,
        "currentState": 15,
        "deltaLimitsValid": False,
        "deltaUpperLimits": [{"fall": 0, "rise": 0}] * 4,
        "deltas": [{"fall": 0, "rise": 0}] * 4,
        "deltasValid": False,
        "initialState": hold,
        **{f"state{n}": hold for n in range(9)},
    }


def _factory_settings() -> list[Json]:
    names = [f"cfg_config_data.dev.HT_sns_amp{n}_gain250_trim" for n in range(1, 5)]
    return [{"actualValue": [TRIM], "defaultValue": [TRIM], "name": name, "offset": 2 * i, "size": 1} for i, name in enumerate(names)]


def _firmware() -> Json:
    return {
        "appCrc": 0,
        "appId": 514,
        "appVersion": 131584,
        "configCrc": 0,
        "configFormat": 67078,
        "configVersion": 20,
        "coreCrc": 0,
        "coreId": 514,
        "coreVersion": 65536,
        "reserved1": [0] * 5,
        "reserved2": [0] * 17,
        "reserved3": [0] * 10,
    }


def _flash_header() -> Json:
    return {
        "AuthBlockVersion": 256,
        "CrcValid": True,
        "FlashFormatHeaderCRC": 0,
        "RlpApiVersion": 19,
        "RlpAppVersion": 0,
        "RlpNotepadSectorNum": 3,
        "RlpNotepadSectorStart": 117,
        "SubjectInfoSectorNum": 4,
        "SubjectInfoSectorStart": 112,
        "reserved": [0] * 8,
    }
