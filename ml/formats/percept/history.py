"""The part of a Percept report that is no session: surveys and tests of sensing, and the history that the device keeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from ml.formats.beta import channel_spectrum
from ml.formats.options import DecodeOptions
from ml.formats.percept import details
from ml.formats.percept.report_json import entries, inside, moment
from ml.formats.percept.streams import time_domains
from ml.formats.recording import FileReport, RecordingLog, SpectrumLog, fingerprint

SURVEYS = ("LfpMontageTimeDomain", "BrainSenseSurveysTimeDomain", "SenseChannelTests", "CalibrationTests")

MOST_NAMES = 12
"""Unknown names that one sentence lists."""
MOST_STORED = 200
"""Unknown names of one report that are stored with its history."""


def _surveys(report: dict[str, Any], said: FileReport, utc: details.ToUtc) -> list[SpectrumLog]:
    """Read spectra of surveys and tests of 20 s, named by channel, section and time in UTC."""
    out: list[SpectrumLog] = []
    seen: set[tuple[str, datetime | None, int]] = set()
    for section in SURVEYS:
        value = report.get(section)
        if section == "BrainSenseSurveysTimeDomain":
            value = _inner(value)
        # newer reports contain a survey twice
        channels = [c for c in time_domains(section, value) if (c.channel, c.first_packet, c.values.size) not in seen]
        seen.update((c.channel, c.first_packet, c.values.size) for c in channels)
        for c in channels:
            when = f" {utc(c.first_packet):%H:%M:%S}" if c.first_packet else ""
            out += channel_spectrum(c.stretches(c.begin_ms), f"{c.channel} {section}{when}")
        if channels:
            said.understood.append(f"{section}: {len(channels)} channels; their spectra are kept, no session")
            said.repaired.extend(dict.fromkeys(f"{section}: {n}" for c in channels for n in c.notes))
            said.flagged.extend(f"{section}, {c.channel}: {loss}" for c in channels for loss in c.losses())
    return out


def _inner(value: Any) -> list[dict[str, Any]]:
    """List entries of a survey as newer versions write it: in lists of their own, by kind of survey."""
    return [inner for entry in entries(value) for held in entry.values() if isinstance(held, list) for inner in entries(held)]


def _counts(dated: Sequence[details.DatedEvent]) -> list[str]:
    """Count events, annotations and ratings, in words."""
    kinds = Counter({"annotation": "annotations", "rating": "ratings"}.get(kind, "events") for _, kind, _, _ in dated)
    return [f"{kinds[name]} {name}" for name in ("events", "annotations", "ratings") if kinds[name]]


def history_recording(
    report: dict[str, Any], said: FileReport, options: DecodeOptions, dated: Sequence[details.DatedEvent], utc: details.ToUtc
) -> RecordingLog | None:
    """Build the recording of surveys and of the device's history: groups, trends, snapshots, events. It belongs to no session.

    Args:
        report: as it was read. `said`: receives what was understood. options: of the decoder. dated: the report's events in UTC.
        utc: converts the report's dates.
    """
    spectra = _surveys(report, said, utc)
    diagnostic = report.get("DiagnosticData")
    trends, void = details.trends(inside(diagnostic, "LFPTrendLogs"), utc)
    kept: dict[str, Any] = {
        "groups": details.groups(inside(report, "Groups", "Final") or inside(report, "Groups", "Initial")),
        "group_history": details.group_history(report.get("GroupHistory"), utc),
        "trends": trends,
        "snapshots": [e for e in details.snapshot_events(inside(diagnostic, "LfpFrequencySnapshotEvents"), utc) if e["spectra"]],
        "montage": details.montage(report.get("LFPMontage") or _inner(report.get("BrainSenseSurveys"))),
        "impedance": details.impedance(report.get("Impedance")),
    }
    kept = {name: value for name, value in kept.items() if value}
    if not (kept or dated or spectra):
        return None
    battery = {k: v for k, v in details.battery(report).items() if v is not None}
    stated = moment(inside(report, "DeviceInformation", "Initial", "DeviceDateTime"))
    started = utc(stated) if stated is not None else dated[0][0] if dated else None
    origin = started or datetime.fromisoformat("2000-01-01T00:00:00+00:00")
    counts = [f"{len(v)} {name.replace('_', ' ')}" for name, v in kept.items()] + _counts(dated)
    if undated := details.undated_events(report):
        entries_of = f"{undated} entr{'y' if undated == 1 else 'ies'} of PatientEvents"
        said.ignored.append(f"{entries_of} without a time: names of events, none that was marked")
    if void:
        said.flagged.append(f"trends: {void} values are the device's sign for no reading, or impossible: gaps")
    names = details.unknown_names(report)
    if names:
        listed = "; ".join(names[:MOST_NAMES]) + (f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else "")
        said.flagged.append(f"names that this version does not know, shown as they are: {listed}")
    if counts:
        said.understood.append(f"history of the device: {', '.join(counts)}; kept, no session")
    return RecordingLog(
        kind="percept",
        device_key=None,
        hemisphere=None,
        clock="device",
        started_at=started,
        duration_s=0.0,
        traces=(),
        events=details.as_events(dated, origin),
        limits={},
        settings={
            "period_s": options.period_s,
            "section": "history",
            **kept,
            **({"battery": battery} if battery else {}),
            **({"unknown_names": names[:MOST_STORED]} if names else {}),
        },
        quality={},
        fingerprint=fingerprint("percept history", [repr((started, kept, dated)), *(s.channel for s in spectra)]),
        spectra=tuple(spectra),
        run=None,
    )
