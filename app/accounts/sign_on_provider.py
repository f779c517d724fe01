"""Exchange with an identity provider: OpenID Connect, authorization code with PKCE. Knows no accounts and no database.

The tokens of a provider are looked at once and not kept. Sources: OpenID Connect Core 1.0 (3.1), Discovery 1.0, RFC 7636, RFC 9207.
"""

from __future__ import annotations

import hmac
import secrets
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any
from urllib.parse import urlencode, urlsplit

import structlog

from app.platform.errors import BetaloopError, Forbidden
from app.settings import Settings, get_settings

log = structlog.get_logger()

RETURN_PATH = "/sign-on/return"
LEEWAY_S = 30
"""By how much the provider's clock may differ from ours, s."""
TIMEOUT_S = 10.0
KEEP_S = 3600.0
"""For how long what the provider publishes of itself is believed, s."""
_KEYS_AGAIN_S = 30.0
ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA")
"""Signatures that are believed: only those made with a private key, whatever the provider offers."""
_LOOPBACK = ("127.0.0.1", "::1", "localhost")


class ProviderAway(BetaloopError):
    """The identity provider does not answer, or not as the standard says."""

    status = 503
    title = "The sign-on is not available"


class Refused(Forbidden):
    """The provider's answer signs no user on."""


@dataclass(frozen=True)
class Begun:
    """Sign-on in progress, remembered in the browser's sealed cookie between the way to the provider and the way back.

    Attributes:
        state, nonce, verifier: random; of the way back, of the ID token, and of PKCE.
        fresh: whether the person has to be asked again, however lately they were.
        at: Unix time, s.
    """

    state: str
    nonce: str
    verifier: str
    fresh: bool
    at: float


@dataclass(frozen=True)
class Identity:
    """Identity of a user whom a provider has checked.

    Attributes:
        issuer, subject: name the person for good. address: an e-mail address that the provider vouches for, or None.
        asked_at: when the provider asked them, by its clock.
    """

    issuer: str
    subject: str
    address: str | None
    asked_at: datetime


def configured() -> bool:
    """Decide whether this installation has a sign-on."""
    return bool(get_settings().oidc_issuer)


def provider() -> Provider:
    """Return the provider of this installation.

    Raises:
        RuntimeError: a setting that it needs is missing or cannot be used.
    """
    return _provider(get_settings())


def _provider(settings: Settings) -> Provider:
    missing = [n for n in ("oidc_issuer", "oidc_client_id", "public_url") if not getattr(settings, n)]
    if missing:
        raise RuntimeError(f"A sign-on needs {', '.join('BETALOOP_' + n.upper() for n in missing)} too.")
    assert settings.oidc_issuer
    assert settings.oidc_client_id
    assert settings.public_url
    for name, address in (("BETALOOP_OIDC_ISSUER", settings.oidc_issuer), ("BETALOOP_PUBLIC_URL", settings.public_url)):
        if not _safe(address):
            raise RuntimeError(f"{name} is {address}: give an address with https (http is for this machine alone).")
    secret = settings.oidc_client_secret.get_secret_value() if settings.oidc_client_secret else ""
    return _made(settings.oidc_issuer, settings.oidc_client_id, secret, settings.public_url.rstrip("/"), settings.oidc_claim)


@lru_cache(maxsize=4)
def _made(issuer: str, client_id: str, secret: str, public_url: str, claim: str) -> Provider:
    return Provider(issuer, client_id, secret, public_url, claim)


def _safe(address: str) -> bool:
    parts = urlsplit(address)
    return bool(parts.hostname) and (parts.scheme == "https" or (parts.scheme == "http" and parts.hostname in _LOOPBACK))


def _random() -> str:
    return secrets.token_urlsafe(32)


class Provider:
    """One provider; used by many threads.

    Args:
        issuer: its address; `/.well-known/openid-configuration` is below it. client_id, secret: ours there, the secret may be empty.
        public_url: where browsers reach this service. claim: the claim with a user's address.
    """

    def __init__(self, issuer: str, client_id: str, secret: str, public_url: str, claim: str = "email") -> None:
        self.issuer, self.client_id, self._secret, self._claim = issuer, client_id, secret, claim
        self._public_url = public_url
        self._lock = threading.Lock()
        self._metadata: dict[str, Any] = {}
        self._keys: Any = None
        self._metadata_at = self._keys_at = -KEEP_S

    def begin(self, max_age_s: int, *, fresh: bool) -> tuple[str, Begun]:
        """Begin a sign-on: return the address that the browser is sent to, and what to remember until it comes back.

        Args:
            max_age_s: how long ago the person may have shown who they are, s. fresh: ask them now, whenever that was.
        """
        begun = Begun(_random(), _random(), _random(), fresh, time.time())
        asked = {"nonce": begun.nonce, "max_age": 0 if fresh else max_age_s} | ({"prompt": "login"} if fresh else {})
        with self._client() as client:
            url, _ = client.create_authorization_url(
                self.metadata()["authorization_endpoint"], state=begun.state, code_verifier=begun.verifier, **asked
            )
        return url, begun

    def finish(self, begun: Begun, answer: Mapping[str, str], max_age_s: int) -> Identity:
        """Identify the user whom the provider has sent back.

        Args:
            begun: what was remembered. answer: the query of the address that the browser came back to. max_age_s: as at the begin.

        Raises:
            Refused: the answer is not that of this begin, says that it was refused, or its ID token is not to be believed.
            ProviderAway: the provider does not answer.
        """
        if not hmac.compare_digest(answer.get("state", "").encode(), begun.state.encode()):
            raise Refused("This answer belongs to another sign-on.", "Begin again from the sign-in page.")
        # RFC 9207: an answer of another provider that an attacker has slipped in
        if answer.get("iss", self.issuer) != self.issuer:
            raise Refused("This answer comes from another provider.", "Begin again from the sign-in page.")
        if "code" not in answer:
            log.warning("sign-on refused by the provider", error=answer.get("error", "")[:100])
            raise Refused("The sign-on was not completed.", "Begin again from the sign-in page, or ask those who run the sign-on.")
        return self._identity(self._exchanged(answer["code"], begun), begun, max_age_s)

    def sign_out_address(self) -> str | None:
        """Build the address where a browser ends its session at the provider, and is sent back from; None where it does not offer that."""
        address = self.metadata().get("end_session_endpoint")
        if not address or not _safe(address):
            return None
        query = {"client_id": self.client_id, "post_logout_redirect_uri": f"{self._public_url}/sign-in"}
        return f"{address}{'&' if '?' in address else '?'}{urlencode(query)}"

    def metadata(self) -> dict[str, Any]:
        """Fetch what the provider publishes of itself. Raises ProviderAway."""
        with self._lock:
            if time.monotonic() - self._metadata_at < KEEP_S:
                return self._metadata
        found = self._fetched(f"{self.issuer.rstrip('/')}/.well-known/openid-configuration")
        needed = ("authorization_endpoint", "token_endpoint", "jwks_uri")
        if found.get("issuer") != self.issuer or not all(isinstance(found.get(n), str) and _safe(found[n]) for n in needed):
            raise self._away("its description names another issuer, or lacks addresses with https")
        with self._lock:
            self._metadata, self._metadata_at = found, time.monotonic()
        return found

    def _client(self) -> Any:
        from authlib.integrations.httpx_client import OAuth2Client  # loaded where there is a sign-on alone

        offered = self.metadata().get("token_endpoint_auth_methods_supported", ["client_secret_basic"])
        method = "client_secret_basic" if "client_secret_basic" in offered else "client_secret_post"
        return OAuth2Client(
            client_id=self.client_id,
            client_secret=self._secret or None,
            token_endpoint_auth_method=method if self._secret else "none",
            code_challenge_method="S256",
            redirect_uri=f"{self._public_url}{RETURN_PATH}",
            scope="openid email",
            timeout=TIMEOUT_S,
        )

    def _exchanged(self, code: str, begun: Begun) -> dict[str, Any]:
        from authlib.common.errors import AuthlibBaseError
        from httpx2 import HTTPError

        try:
            with self._client() as client:
                return dict(client.fetch_token(self.metadata()["token_endpoint"], code=code, code_verifier=begun.verifier))
        except AuthlibBaseError as error:
            log.warning("sign-on refused by the provider", error=str(error)[:200])
            raise Refused("The provider did not confirm this sign-on.", "Begin again from the sign-in page.") from error
        except (HTTPError, ValueError) as error:
            raise self._away(type(error).__name__) from error

    def _identity(self, token: dict[str, Any], begun: Begun, max_age_s: int) -> Identity:
        from authlib.oidc.core import CodeIDToken
        from joserfc.errors import JoseError

        try:
            decoded = self._decoded(token.get("id_token"))
            claims = CodeIDToken(
                decoded.claims,
                decoded.header,
                {
                    "iss": {"essential": True, "value": self.issuer},
                    "aud": {"essential": True, "value": self.client_id},
                    "nonce": {"essential": True, "value": begun.nonce},
                    "auth_time": {"essential": True},
                },
                {"nonce": begun.nonce, "client_id": self.client_id, "max_age": 1, "access_token": token.get("access_token")},
            )
            claims.validate(leeway=LEEWAY_S)
        except (JoseError, ValueError, TypeError) as error:
            log.warning("ID token refused", error=type(error).__name__, what=str(error)[:200])
            raise Refused("The provider's statement about you cannot be verified.", "Inform those who run the sign-on.") from error
        earliest = begun.at if begun.fresh else time.time() - max_age_s
        if claims["auth_time"] < earliest - LEEWAY_S:
            raise Refused("The provider has not asked you again who you are.", "Begin again, and give your password there.")
        subject = claims["sub"]
        if not isinstance(subject, str) or not 0 < len(subject) <= 255:
            raise Refused("The provider's statement about you names no user.", "Inform those who run the sign-on.")
        if claims["auth_time"] > time.time() + LEEWAY_S:
            raise Refused("The provider's clock is ahead of ours.", "Inform those who run the sign-on.")
        return Identity(self.issuer, subject, self._address(claims), datetime.fromtimestamp(claims["auth_time"], UTC))

    def _address(self, claims: Mapping[str, Any]) -> str | None:
        address = claims.get(self._claim)
        vouched = self._claim != "email" or claims.get("email_verified") is True
        return address if isinstance(address, str) and vouched else None

    def _decoded(self, token: Any) -> Any:
        from joserfc import jws, jwt
        from joserfc.errors import BadSignatureError, InvalidKeyIdError, JoseError

        if not isinstance(token, str):
            raise ValueError("there is no ID token")
        registry = jws.JWSRegistry(algorithms=list(ALGORITHMS), strict_check_header=False)
        try:
            return jwt.decode(token, self._key_set(), registry=registry)
        except (InvalidKeyIdError, BadSignatureError, KeyError) as error:
            # keys are renewed now and then: look once more, but not for every forged token
            with self._lock:
                lately = time.monotonic() - self._keys_at < _KEYS_AGAIN_S
            if lately:
                raise error if isinstance(error, JoseError) else ValueError("no such key") from error
        return jwt.decode(token, self._key_set(again=True), registry=registry)

    def _key_set(self, again: bool = False) -> Any:
        from joserfc.errors import JoseError
        from joserfc.jwk import KeySet

        with self._lock:
            if self._keys is not None and not again and time.monotonic() - self._keys_at < KEEP_S:
                return self._keys
        try:
            keys = KeySet.import_key_set(self._fetched(self.metadata()["jwks_uri"]))  # type: ignore[arg-type]
        except (JoseError, ValueError, KeyError, TypeError) as error:
            raise self._away("its keys cannot be read") from error
        with self._lock:
            self._keys, self._keys_at = keys, time.monotonic()
        return keys

    def _fetched(self, address: str) -> dict[str, Any]:
        import httpx2

        try:
            answer = httpx2.get(address, timeout=TIMEOUT_S)
            answer.raise_for_status()
            found = answer.json()
        except (httpx2.HTTPError, ValueError) as error:
            raise self._away(type(error).__name__) from error
        if not isinstance(found, dict):
            raise self._away("its answer is no JSON object")
        return found

    def _away(self, reason: str) -> ProviderAway:
        log.warning("the identity provider cannot be used", issuer=self.issuer, reason=reason)
        return ProviderAway(
            f"{get_settings().oidc_name} does not answer as it should.", "Sign in with your password, or try again in a while."
        )
