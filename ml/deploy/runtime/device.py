"""A device side in a page: sends beta, obeys amplitudes, and goes back to clinical settings by itself. A reference, not a driver.

`python -m controller.device PORT PARTICIPANT SIDE UNIT SOURCE < betas` sends one number of standard input per period to a runner on this
machine, and prints what it stimulates with. Whatever drives a stimulator does what `DeviceSide` does.
"""

from __future__ import annotations

import socket
import sys
import time

LATEST = 0.5  # a message may come this share of a period late before it counts as missing


class DeviceSide:
    """Amplitude of the stimulation, and its reason.

    Args:
        participant, side: who is connected; `-` for a side that is not stated. clinical_ma: cDBS amplitude, as programmed.
        min_ma, max_ma: the device's own limits, which no message leaves.
    """

    def __init__(self, participant: str, side: str, clinical_ma: float, min_ma: float, max_ma: float) -> None:
        self._who, self._clinical_ma, self._limits = (participant, side), clinical_ma, (min_ma, max_ma)
        self._period_s, self._watchdog, self._seq = 2.0, 2, -1
        self._last_s: float | None = None
        self.amplitude_ma, self.why = clinical_ma, "waiting"
        self.over = False

    def hear(self, line: str, now_s: float) -> None:
        """Take a line of the runner; one without its end, or that is no message, is as good as none."""
        words = line.split()
        if self.over or not line.endswith("\n"):
            return
        try:
            if words[0] == "controller" and (words[2], words[3]) == self._who:
                self._period_s, self._watchdog = float(words[4]) / 1000, int(words[8])
            elif words[0] == "amplitude" and int(words[1]) > self._seq:
                wanted, (low, high) = float(words[3]), self._limits
                if not low <= wanted <= high:
                    return self._clinical("amplitude outside the device's limits")
                self._seq, self._last_s = int(words[1]), now_s
                self.amplitude_ma, self.why = wanted, words[4]
            elif words[0] in ("end", "refused", "controller"):
                self._clinical(" ".join(words))
        except (ValueError, IndexError):
            return  # no message: the watchdog counts it as missing
        return None

    def look(self, now_s: float) -> float:
        """Return the amplitude in force, mA; call it several times per period. With the watchdog's messages missing: clinical settings."""
        if not self.over and self._last_s is not None and now_s - self._last_s > (self._watchdog + LATEST) * self._period_s:
            self._clinical("watchdog")
        return self.amplitude_ma

    def _clinical(self, why: str) -> None:
        self.amplitude_ma, self.why, self.over = self._clinical_ma, why, True


def main(port: int, participant: str, side: str, unit: str, source: str) -> int:
    """Send the numbers of standard input, one per period, and print the amplitude in force whenever it changes."""
    with socket.create_connection(("127.0.0.1", port)) as link:
        link.settimeout(0.05)
        head, rest = b"", b""
        while not head.endswith(b"\n"):
            head += _receive(link)
        device = DeviceSide(participant, side, float(head.split()[5]), float(head.split()[6]), float(head.split()[7]))
        device.hear(head.decode("ascii"), time.monotonic())
        period_s, shown = float(head.split()[4]) / 1000, ""
        link.sendall(f"hello 1 {participant} {side} {unit} {source} {1000 * period_s:g}\n".encode())
        began, seq = time.monotonic(), 0
        while not device.over:
            if time.monotonic() >= began + seq * period_s and (beta := sys.stdin.readline().strip()):
                link.sendall(f"beta {seq} {1000 * (time.monotonic() - began):.0f} {beta} {unit} {source}\n".encode())
                seq += 1
            *lines, rest = (rest + _receive(link)).split(b"\n")
            for line in lines:
                device.hear(line.decode("ascii") + "\n", time.monotonic())
            now = f"{device.look(time.monotonic()):g} mA {device.why}"
            if now != shown:
                sys.stdout.write(now + "\n")
                sys.stdout.flush()
                shown = now
    return 0


def _receive(link: socket.socket) -> bytes:
    """Receive what has come within a moment; nothing where the runner is gone, too: the watchdog sees to that."""
    try:
        content = link.recv(4096)
    except OSError:
        return b""
    if not content:
        time.sleep(0.05)
    return content


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), *sys.argv[2:6]))
