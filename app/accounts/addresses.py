"""E-mail addresses as users type them: one spelling under which they are stored, looked up and counted."""

from __future__ import annotations

import unicodedata

LONGEST_ADDRESS = 254
"""RFC 5321, 4.5.3.1.3: a path of 256 octets, less its brackets."""


def normal_address(email: str) -> str | None:
    """Normalise an address to its one spelling; None for what no address can be.

    Outer white space goes, look-alike forms become one (NFKC), capitals and small letters count as the same. An address with control,
    invisible or unassigned characters, or of more than 254 characters, is none.
    """
    folded = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", email).strip().casefold()).lower().strip()
    if not folded or len(folded) > LONGEST_ADDRESS or any(unicodedata.category(c).startswith("C") for c in folded):
        return None
    return folded
