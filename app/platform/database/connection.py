"""Address of an external PostgreSQL, with the connection options that make betaloop notice a server that vanishes.

Without them the operating system, and every process that asked, waits a quarter of an hour for a machine that no longer answers.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

NOTICED: Final = {
    "connect_timeout": "5",
    "keepalives": "1",
    "keepalives_idle": "3",
    "keepalives_interval": "2",
    "keepalives_count": "3",
    "tcp_user_timeout": "9000",
}
"""Parameters of libpq: s, but the last one in ms. A vanished server ends a connection within 9 s; each host then has 5 s to answer."""

WRITABLE: Final = {"target_session_attrs": "read-write"}
"""With several hosts: the one that takes writes, so that a standby is left alone until it is promoted."""


@lru_cache(maxsize=8)  # every request asks
def connection_url(setting: str, url: str) -> str:
    """Build SQLAlchemy's URL from a setting. It accepts several hosts as libpq writes them, adds `NOTICED` and keeps what the URL states.

    Args:
        setting: its name, for errors. url: such as postgresql://USER:PASSWORD@HOST:5432,OTHER:5432/DATABASE.

    Raises:
        RuntimeError: another database than PostgreSQL, or a URL that cannot be read; the message holds no password.
    """
    scheme, _, rest = url.partition("://")
    if scheme not in {"postgres", "postgresql", "postgresql+psycopg"}:
        raise RuntimeError(f"{setting} must start with postgresql://, not {scheme}://: betaloop runs on PostgreSQL alone")
    end = min((i for i in (rest.find("/"), rest.find("?")) if i >= 0), default=len(rest))
    user, at, hosts = rest[:end].rpartition("@")
    several = hosts.split(",") if "," in hosts else []
    try:
        found = make_url(f"postgresql+psycopg://{user}{at}{'' if several else hosts}{rest[end:]}")
    except (ArgumentError, ValueError):
        raise RuntimeError(
            f"{setting} cannot be read: write postgresql://USER:PASSWORD@HOST:PORT/DATABASE, several hosts with commas between them"
        ) from None
    if several:
        parts = [_host(setting, part) for part in several]
        found = found.update_query_dict({"host": ",".join(h for h, _ in parts), "port": ",".join(p for _, p in parts)})
    added = NOTICED | (WRITABLE if _hosts(found) > 1 else {})
    return found.update_query_dict({k: v for k, v in added.items() if k not in found.query}).render_as_string(hide_password=False)


def _host(setting: str, part: str) -> tuple[str, str]:
    """Split one of several hosts into host and port; an IPv6 address is in brackets."""
    host, colon, port = part.rpartition(":") if not part.endswith("]") else (part, "", "")
    host, port = (host, port) if colon else (part, "5432")
    if not host or not port.isdigit():
        raise RuntimeError(f"{setting} names the host {part!r}: write HOST:PORT,HOST:PORT")
    return host.strip("[]"), port


def _hosts(url: URL) -> int:
    named = url.query.get("host", "")
    return len(named) if isinstance(named, tuple) else len(named.split(","))
