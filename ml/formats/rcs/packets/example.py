"""A small RC+S recording, with which a process loads all that the decoder needs before a file comes."""

from __future__ import annotations

import zipfile
from pathlib import Path

_RECORD = """[{"RecordInfo":{"DeviceId":"E","HostUnixTime":1700000000000,"SessionId":"1700000000000"},"TimeDomainData":[%s]}]"""
_PACKET = (
    '{"Header":{"dataSize":100,"dataType":1,"dataTypeSequence":%d,"globalSequence":%d,"info":0,"systemTick":%d,"timestamp":{"seconds":%d},'
    '"user1":1,"user2":1},"PacketGenTime":%d,"PacketRxUnixTime":%d,"ChannelSamples":[{"Key":0,"Value":[%s]}],"DebugInfo":0,'
    '"EvokedMarker":[],"IncludedChannels":1,"SampleRate":1,"Units":"millivolts"}'
)


def write_example(target: Path) -> None:
    """Write a zip with 8 s of one channel at 500 Hz."""
    packets = ",".join(
        _PACKET % (i, i, 1000 * i, 700_000_000 + i // 10, 1_700_000_000_000 + 100 * i, 1_700_000_000_000 + 100 * i, ",".join(["0.5"] * 50))
        for i in range(80)
    )
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("RawDataTD.json", _RECORD % packets)
