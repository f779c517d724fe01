"""Files of every kind with a name, a date of birth, serial numbers and notes in every place that can hold one."""

from __future__ import annotations

import io
import json
import stat
import struct
import warnings
import zipfile
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.ml.formats.conftest import Percept, Rcs

NAME, BORN, SERIAL, LEAD, NUMBER, NOTE = "Plantedname", "1901-02-03", "NPC477100H", "LEAD477100", "MRN0047110", "plantednote"
TOKENS = (NAME, BORN, "19010203", "03.02.1901", SERIAL, LEAD, NUMBER, NOTE)
WHO = f"{NAME} {BORN} {NUMBER}"
FOLDER = f"{WHO} 19010203"


def _sine(seconds: int = 60) -> np.ndarray:
    return 0.01 * np.sin(2 * np.pi * 20 * np.arange(500 * seconds) / 500)


def _marked(records: Any) -> Any:
    """Mark records whose RecordInfo names the planted serial, with a field and a text that no device writes."""
    for record in records:
        record["RecordInfo"] |= {"DeviceId": SERIAL, "SubjectId": WHO, "ClientNote": NOTE}
        record[NAME] = {"Born": BORN, "03.02.1901": WHO}
    return records


def rcs_members() -> dict[str, bytes]:
    """Return the files of an RC+S session by name."""
    rcs = Rcs()
    settings = rcs.settings()
    settings[0]["SubjectInfo"] = {"ID": WHO, "DateOfBirth": BORN, "ClinicianNotes": NOTE, "ImplantDate": "03.02.1901", "LeadSerial": LEAD}
    settings[0]["GeneralData"]["deviceName"] = NAME
    settings[0]["BatteryStatus"] = NAME
    parts = {
        "RawDataTD": rcs.time_domain(_sine()),
        "DeviceSettings": settings,
        "StimLog": rcs.stim((0, rcs.program(1.0))),
        "EventLog": [rcs.note(5.0, f"{NOTE} {WHO}"), rcs.note(9.0, f"{SERIAL} 1.5 mA", swapped=True)],
    }
    return {f"{stem}.json": json.dumps(_marked(records)).encode() for stem, records in parts.items()}


def rcs_zip() -> bytes:
    """Build a session folder named after a person, with members of every kind that is ignored."""
    sink, device = io.BytesIO(), f"{FOLDER}/Session1700000000000/Device{SERIAL}"
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the member that is there twice
        archive.comment = WHO.encode()
        for name, content in rcs_members().items():
            archive.writestr(f"{device}/{name}", content)
        archive.writestr(f"{device}/StimLog.json", b"[]")  # twice
        link = zipfile.ZipInfo(f"{FOLDER}/{NAME}_link.json")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, f"/home/{NAME}")
        archive.writestr(f"../{WHO}.json", b"[]")
        archive.writestr(f"{FOLDER}/scan.{NAME}", NOTE)
        archive.writestr(f"{FOLDER}/letter.19010203", NOTE)
        archive.writestr(f"{FOLDER}/LogOf{NAME}.json", json.dumps([{WHO: NOTE}]))
        archive.writestr(f"{FOLDER}/{NAME} large.json", b"[]")
        for number in range(20):
            archive.writestr(f"{FOLDER}/{NAME} {number}.zip", b"PK")
    raw = bytearray(sink.getvalue())
    # the directory claims 1.2 GB for one member, packed to 100 MB
    entry = raw.rfind(b"PK\x01\x02", 0, raw.rfind(f"{NAME} large.json".encode()))
    raw[entry + 20 : entry + 28] = struct.pack("<II", 100_000_000, 1_200_000_000)
    return bytes(raw)


def rcs_damaged() -> bytes:
    """Build a session of which one file cannot be unpacked, and one cannot be read."""
    sink, device = io.BytesIO(), f"{FOLDER}/Device{SERIAL}"
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for name, content in rcs_members().items():
            archive.writestr(f"{device}/{name}", b"\xff\xfe" + WHO.encode() if name == "EventLog.json" else content)
    raw = bytearray(sink.getvalue())
    at = raw.find(b"DeviceSettings.json") + 4000
    raw[at : at + 20] = bytes(20)
    return bytes(raw)


def percept_report() -> dict[str, Any]:
    """Build a Percept report."""
    percept = Percept()
    report = percept.one_run(lost=(4,))
    report["PatientInformation"] = {
        "Final": {
            "PatientFirstName": NAME,
            "PatientLastName": NAME,
            "PatientId": NUMBER,
            "PatientDateOfBirth": BORN,
            "ClinicianNotes": NOTE,
        }
    }
    report["DeviceInformation"]["Final"] |= {"NeurostimulatorSerialNumber": SERIAL, "DeviceName": NAME, "ImplantDate": f"{BORN}T00:00:00Z"}
    report["LeadConfiguration"] = {"Final": [{"Hemisphere": "HemisphereLocationDef.Right", "LeadSerialNumber": LEAD, "Model": NAME}]}
    report["BrainSenseTimeDomain"][0] |= {"Pass": NAME, f"{NAME} Annotations": [{"OffsetInSeconds": 5, "Text": WHO, "Author": NAME}]}
    event = {"EventName": f"{NOTE} {NAME}", "EventID": 3, "DateTime": "2024-03-14T10:00:00Z", "Note": NOTE}
    return report | {
        "PatientEvents": {"Initial": [event]},
        "Groups": {"Final": [{"GroupId": "GroupIdDef.GROUP_A", "GroupName": f"{NAME}'s", "ActiveGroup": True, "ProgramSettings": {}}]},
        "ClinicianNotes": f"{NOTE} 03.02.1901",
        WHO: {NAME: BORN},
        f"{NAME}Ratings": [
            {"DateTime": "2024-03-14T10:05:55Z", "Tremor": 4, NAME: 3, "Name": NAME, "Under": f"{NAME} ratings", "DateOfBirth": BORN},
            {"DateTime": f"{BORN}T00:00:00Z", "Score": 19010203, "Text": f"{NOTE} tremor"},
        ],
        "EventSummary": {"Note": NOTE, WHO: 1, "DOB": BORN},
        "DiagnosticData": {"EventLogs": [{"DateTime": "2024-03-14T10:00:00Z", "Comment": NOTE, "SessionType": f"SessionStateDef.{NAME}"}]},
    }


def percept_zip() -> bytes:
    """Build reports in folders named after a person; one cannot be read, others are ignored."""
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        report = percept_report()
        report["BrainSenseTimeDomain"][0]["Gain"] = 228
        archive.writestr(f"{FOLDER}/{NAME}.json", json.dumps(report))
        archive.writestr(f"{FOLDER}/{NAME} cut.json", json.dumps(report)[:5000])
        archive.writestr(f"{FOLDER}/{NAME}.zip", b"PK")
        archive.writestr(f"{FOLDER}/{NAME}.pdf", NOTE)
    return sink.getvalue()


def steps(beta: float = 1.0, cell: str = "1") -> str:
    """Write a table of steps with columns of a name and a note; `cell` is the last amplitude."""
    head = f"t_s,beta,amplitude_fraction,{NAME},comment,{BORN}\n"
    rows = [f"{2 * k},{beta + k / 100},1,{NUMBER},{NOTE} {WHO},{SERIAL}\n" for k in range(20)]
    return head + "".join(rows) + f"40,1,{cell},,,\n"


def unknown_columns() -> str:
    """Write an unknown table, with a name in its title, in a column's name and in cells, and numbers that are a person's."""
    head = f"{WHO}; {NOTE}\nZeit {NAME};Signal;{NUMBER};Patient;{BORN};Strom\n"
    return head + "".join(f"{2 * k};{k / 7:.3f};{NUMBER};{NAME};{BORN};1.5\n" for k in range(1, 15))


MAPPING = {
    "name": "a clinic's program",
    "header_line": 2,
    "holds": "steps",
    "time_format": "seconds",
    "time_at": "end",
    "columns": [
        {"number": 1, "role": "time"},
        {"number": 2, "role": "beta", "unit": "uV"},
        {"number": 6, "role": "amplitude_ma", "unit": "mA"},
    ],
}
"""What the columns of `unknown_columns` are."""


def parquet() -> bytes:
    """Write a table whose columns and metadata contain a name."""
    n = 20
    table = pa.table(
        {"t_s": [2.0 * k for k in range(n)], "beta": [3.0 + k / 100 for k in range(n)], "amplitude_fraction": [1.0] * n, NAME: [NOTE] * n}
    )
    sink = io.BytesIO()
    pq.write_table(table.replace_schema_metadata({NAME: WHO}), sink)
    return sink.getvalue()


def tremor() -> str:
    """Write minutes of tremor with the wearer's columns."""
    head = f"time,unknown,none,slight,mild,moderate,strong,{NAME},user\n"
    return head + "".join(f"{1_772_445_600 + 60 * k},0,0.5,0.25,0.25,0,0,{NOTE},{WHO}\n" for k in range(10))


def grasps() -> str:
    """Write a grasp test with a column of names."""
    return f"t_s,hand,{NAME}\n" + "".join(f"{k / 2},L,{NOTE}\n" for k in range(1, 8))


def every_file() -> list[tuple[str, bytes]]:
    """List all of them, by names that contain a person's too."""
    loose = [(f"{FOLDER}/Device{SERIAL}/{name}", content.replace(b"0.00", b"0.01")) for name, content in rcs_members().items()]
    return [
        (f"{WHO}.zip", rcs_zip()),
        (f"{WHO} damaged.zip", rcs_damaged()),
        *loose,
        (f"{WHO}.json", json.dumps(percept_report()).encode()),
        (f"{WHO} reports.zip", percept_zip()),
        (f"{WHO} cut.json", json.dumps(percept_report())[:4000].encode()),
        (f"{WHO}.csv", steps().encode()),
        (f"{WHO} words.csv", steps(2.0, f"{NAME}").encode()),
        (f"{WHO} columns.csv", f"{NAME},{BORN}\n{NOTE},{SERIAL}\n".encode()),
        (f"{WHO} unknown.csv", unknown_columns().encode()),
        (f"{WHO}.parquet", parquet()),
        (f"{WHO} tremor.csv", tremor().encode()),
        (f"{WHO} grasps.csv", grasps().encode()),
        (f"noise.{NAME}", f"\x00\x01{WHO} {NOTE}".encode()),
        ("noise.19010203", f"\x00\x02{WHO} {NOTE}".encode()),
        (f"{WHO} empty.csv", b""),
        (f"{WHO}/.DS_Store", NAME.encode()),
        (f"{WHO} pictures.zip", _pictures()),
    ]


def _pictures() -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w") as archive:
        for number in range(20):
            archive.writestr(f"{FOLDER}/{NAME} {number}.jpg", NOTE)
        archive.writestr(f"{FOLDER}/{NAME}.{NAME}.zip", b"PK")
    return sink.getvalue()
