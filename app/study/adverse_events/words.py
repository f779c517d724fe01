"""Words of adverse events."""

from __future__ import annotations

from app.tables.adverse_events import EventKind, Severity

EVENT_KINDS = {
    EventKind.DYSKINESIA: "Dyskinesia",
    EventKind.SPEECH: "Speech",
    EventKind.GAIT: "Gait or balance",
    EventKind.FALL: "Fall",
    EventKind.MUSCLE_CONTRACTION: "Muscle contraction",
    EventKind.PARAESTHESIA: "Paraesthesia",
    EventKind.VISION: "Vision",
    EventKind.MOOD: "Mood",
    EventKind.COGNITION: "Thinking or confusion",
    EventKind.PAIN: "Pain",
    EventKind.NAUSEA: "Nausea",
    EventKind.DEVICE: "Device",
    EventKind.STOPPED: "Session stopped for the participant's sake",
    EventKind.OTHER: "Other",
}


EVENT_SEVERITIES = {Severity.NONE: "none", Severity.MILD: "mild", Severity.SEVERE: "severe", Severity.NOT_STATED: "not stated"}
