"""Keys that the files of an RC+S session are known to have; values of any other key are not stored.

They are those of the format notes and of real recordings. Keys that name a person or a device are not among them: `redact` treats
them first.
"""

from __future__ import annotations

import re

KEYS = frozenset(
    re.findall(
        r"\w+",
        """
        AccelData AccelStreamEnabled AdaptiveConfig AdaptiveStreamEnabled AdaptiveUpdate AmplitudeInMilliamps
        AmplitudeLimitsGroup0 AmplitudeLimitsGroup1 AmplitudeLimitsGroup2 AmplitudeLimitsGroup3 ApiVer AuthBlockVersion
        AverageLatency Bands BatteryLevel BatteryStatus BeepEnables Channel ChannelSamples ChopClockSettings CommandType
        CrcError CrcValid CtmCommandCode CurrentAdaptiveState CurrentProgramAmplitudesInMilliamps DebugInfo Descriptor
        DetectionConfig DetectionStreamEnabled DeviceId Diagnostic DiagnosticType Error Event EventName EventSubType EventType
        EvokedMarker ExternalValuesMask FactorySettings FftData FftOutput FftSize FftStreamEnabled FirmwareID FirmwareVersion
        FlashFormatHeader FlashFormatHeaderCRC GeneralData Header HostUnixTime IncludedChannels Index InsCommandCode
        IsConnected IsInHoldOffOnStartup IsPowerChannelOverrange Key LatencyMilliseconds LatencyResultsDiagnostic Ld0
        Ld0DetectionStatus Ld0Status Ld1 Ld1DetectionStatus Ld1Status LoopRecordMarkerEchoStreamEnabled
        MaxStackDueToOorUnreliable ModuleType OOR OorData PacketGenTime PacketRxUnixTime PhysicalLayer PorHasOccurred
        PowerDomainData PowerDomainStreamEnabled PreviousAdaptiveState PulseWidthInMicroseconds RateInHz ReadFlashMirror
        RecordInfo RecordsLost RejectCode RlpApiVersion RlpAppVersion RlpNotepadSectorNum RlpNotepadSectorStart SampleRate SenseState
        SensingConfig SensingStatus SequenceError SequenceNumber SessionId SessionInitWarnings StateEntryCount StateTime
        StatusChange1 StimFlags StimRateInHz StreamState StreamsEnabled SubjectInfoSectorNum SubjectInfoSectorStart
        TelemetryModuleInfo TelmMode TelmRatio TestPacketNum TheLinkStatus TherapyConfigGroup0 TherapyConfigGroup1
        TherapyConfigGroup2 TherapyConfigGroup3 TimeDomainData TimeDomainStreamEnabled TimeSyncData TimeSyncStreamEnabled
        TransmitAttempts Units UnixOffsetTime UnixOnsetTime Unused1 Unused2 UtcOffset ValidDataMask Valids Value WireType
        WriteCount XSamples YSamples ZSamples __type accelRate activeGroup activeRechargeRatio actualValue adaptiveMode
        adaptiveStatus amplitude amplitudeInMilliamps amplitudeResolution0_2mA appCrc appId appVersion band0Start band0Stop
        band1Start band1Stop bandEnable bandFormationConfig batteryLevelPercent batterySOC batteryStatus batteryVoltage
        biasTerm blankingDurationUponStateChange blankingExtensionTime bridging caseOorStatus chopClockSettings config
        configCrc configFormat configVersion coreCrc coreId coreVersion currentMode currentStackData currentStackType
        currentState cycleOffTime cycleOnTime cyclingEnable cyclingEnabled dataSize dataType dataTypeSequence daysUntilEos
        defaultValue deltaLimitsValid deltaUpperLimits deltas deltasValid detectionEnable detectionInputs deviceTime elecValue
        electrodeType electrodes estimatedCapacity evokedMode fall featureInputs features fftConfig fftStreamChannel
        fixedDecimalPoint flashCorruptLifetime flashCorruptThisPor fractionalFixedPointValue fullSOC gain globalSequence
        highThreshold holdoffTime hpf info initialState interval isEnabled isEos isEri isInCPSession isMriModeOn isOff
        isOvervoltage isTherapyUnavailable isValid l380BlankEnableRegisterMode lowThreshold lpf1 lpf2 lrPostBufferTime
        lrTriggers manufacturedCapacity minusInput miscSensing miscSettings mode name normalizationMultiplyVector
        normalizationSubtractVector offset onsetDuration oorMaxStack output outputMode plusInput powerChannels prog0Amp
        prog0AmpInMilliamps prog0Lower prog0LowerInMilliamps prog0Upper prog0UpperInMilliamps prog1Amp prog1AmpInMilliamps
        prog1Lower prog1LowerInMilliamps prog1Upper prog1UpperInMilliamps prog2Amp prog2AmpInMilliamps prog2Lower
        prog2LowerInMilliamps prog2Upper prog2UpperInMilliamps prog3Amp prog3AmpInMilliamps prog3Lower prog3LowerInMilliamps
        prog3Upper prog3UpperInMilliamps program0 program1 program2 program3 programData programs pulseWidth
        pulseWidthInMicroseconds pulseWidthLowerLimit pulseWidthLowerLimitInMicroseconds pulseWidthUpperLimit
        pulseWidthUpperLimitInMicroseconds ramCorruptThisPor rampRepeat rampTime rateInHz rateLowerLimitInHz ratePeriod
        ratePeriodLowerLimit ratePeriodUpperLimit rateTarget rateTargetInHz rateUpperLimitInHz rawFlashCorruptStatusData
        regulatorOor rejectType reserved reserved0 reserved1 reserved2 reserved3 reservedRateMult rise sampleRate seconds
        senseBlanking size socUncertainty state state0 state1 state2 state3 state4 state5 state6 state7 state8
        streamOffsetBins streamSizeBins streamingRate subvalid systemTick terminationDuration therapyStatus therapyStatusData
        therapyUnavailableSOC time timeDomainChannels timestamp type units unixRxTime unixTxTime unused unused2 updateRate
        user1 user2 valid weightVector windowLoad
        """,
    )
)
