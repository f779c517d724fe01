"""Keys that a Percept session report is known to have below its sections, and that hold nothing of a person; no other is stored."""

from __future__ import annotations

import re

KEYS = frozenset(
    re.findall(
        r"\w+",
        """
        AccumulatedTherapyOnTimeSinceFollowup AccumulatedTherapyOnTimeSinceImplant ActiveGroup AdaptiveStartupDelayInMilliSeconds
        AdaptiveTherapy AdaptiveTherapyStatus AdjustableParameter AmplitudeControl AmplitudeInMilliAmps ArtifactStatus
        AveragingDurationInMilliSeconds BatteryPercentage BatteryStatus Bipolar BrainSensingStatus Channel ChannelSignalResult
        CoreApplicationId CoreVersion Cycling CyclingStatus CycleOffDurationInSeconds CycleOnDurationInSeconds DateTime DateTimeBlockId
        DateTimeOffsetInSeconds DetectionBlankingDurationInMilliSeconds DeviceApplicationId DeviceDateTime DeviceDateTimeBlockId
        DeviceDateTimeOffsetInSeconds DeviceVersion DurationInSeconds Electrode Electrode1 Electrode2 ElectrodeAmplitudeInMilliAmps
        ElectrodeFractionOf64 ElectrodeIdentifier ElectrodeNumber ElectrodeState ElectrodeStateResult ElectrodeSurvey Enabled
        EstimatedBatteryLifeMonths EventDateTime EventID EventId EventLogs EventName FFTBinData Final FinalStimStatus
        FirstPacketDateTime FirstPacketDateTimeBlockId FirstPacketDateTimeOffsetInSeconds Frequency FrequencyInHertz FrequencyIndex Gain
        GangedToHemisphere GlobalPacketSizes GlobalSequences GroupId GroupSettings Groups Hemisphere HemisphereLocation
        HighPassFilterInHertz ImpedanceStatus Initial InitialStimStatus LFP LFPFrequency LFPFrequencyinHertz LFPMagnitude
        LFPMagnitudeinMicroVoltPeak LFPTrendLogs LeadLocation Left LeftHemisphere LfpData LfpFrequencySnapshotEvents
        LowerCaptureAmplitudeInMilliAmps LowerLfpThreshold LowerLimitInMilliAmps LowerThresholdOnsetInMilliSeconds MeasuredLowerLfp
        MeasuredUpperLfp Mode Model Monopolar Neurostimulator NeurostimulatorLocation NeurostimulatorModel NewGroupId OldGroupId
        OrientationInDegrees OverdischargeCount ParameterTrendId Pass PeakFrequencies PeakFrequencyInHertz PeakMagnitudeInMicroVolt
        PeakValues ProductApplicationId ProductVersion ProgramId ProgramSettings Programs PulseWidthInMicroSecond RateInHertz
        ResultValue RechargeSessionType OffDurationInMilliSeconds OffDurationInSeconds OnDurationInMilliSeconds OnDurationInSeconds
        Right RightHemisphere SampleRateInHz SenseID SensingBlankingDurationInMicroseconds SensingChannel SensingElectrodes SensingSetup
        SensingStatus Seq SessionDate SessionEndDate SessionImpedance SessionStartDate SessionType Sessiondate Settings
        SignalFrequencies SignalPsdValues SoftStartStop StatusBytes SurveyMode SuspendAmplitudeInMilliAmps TherapySnapshot TherapyStatus
        TestCurrentMA TicksInMs TicksInMses TimeDomainData TimeDomainDatainMicroVolts TipOffset TransitionDownInMilliSeconds
        TransitionUpInMilliSeconds UpperCaptureAmplitudeInMilliAmps UpperLfpThreshold UpperLimitInMilliAmps
        UpperThresholdOnsetInMilliSeconds UsagePercentage mA
        """,
    )
)
