"""A small OpenID Connect provider on a socket, as a hospital has one: it asks people, keeps them signed in, checks its clients.

It is written after the standard and not after betaloop. It refuses what the standard does: a foreign return address, a missing PKCE
challenge, a wrong verifier, a code that is used twice. So a test that comes back signed on has done all of it right.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

from joserfc import jwt
from joserfc.jwk import KeySet, RSAKey

CLIENT_ID, CLIENT_SECRET = "betaloop-at-the-clinic", "a secret: of both"


@dataclass
class Person:
    """A user who knows their password there."""

    subject: str
    email: str
    email_verified: bool = True


@dataclass
class Provider:
    """The provider's state; tests change it between requests.

    Attributes:
        person: who sits at the browser when a password is asked for; None: no password is given. present: who is signed in there, since
            when.
        asked: how often a password was asked for. change: claims of the next ID tokens that differ; None takes one out.
        key, kid, algorithm: what ID tokens are signed with. published: what the provider says its keys are.
    """

    return_address: str
    issuer: str = ""
    person: Person | None = None
    present: tuple[Person, float] | None = None
    asked: int = 0
    change: dict[str, Any] = field(default_factory=dict)
    key: Any = None
    algorithm: str = "RS256"
    published: list[Any] = field(default_factory=list)
    secret: str = CLIENT_SECRET
    codes: dict[str, dict[str, Any]] = field(default_factory=dict)
    key_reads: int = 0
    last_login: float = 0.0

    def renew_key(self) -> None:
        """Sign with a new key from now on, and publish that one alone."""
        self.key = RSAKey.generate_key(2048, {"kid": secrets.token_hex(4), "use": "sig"})
        self.published = [self.key]

    def sign_with_the_public_key(self) -> None:
        """Sign by the old trick: the public key, which everyone has, as the secret of a symmetric signature."""
        self.algorithm = "HS256"

    def _signed(self, claims: dict[str, Any]) -> str:
        if self.algorithm == "RS256":
            return jwt.encode({"alg": "RS256", "kid": self.key.kid}, claims, self.key)
        # by hand: no library makes these
        header = {"alg": self.algorithm, "kid": self.key.kid}
        parts = ".".join(_base64(json.dumps(part).encode()) for part in (header, claims))
        if self.algorithm == "none":
            return f"{parts}."
        return f"{parts}.{_base64(hmac.digest(self.key.as_pem(private=False), parts.encode(), hashlib.sha256))}"

    def authorize(self, query: dict[str, str]) -> str:
        """Return the address that the browser is sent to; raises ValueError where the standard forbids to send it anywhere."""
        if query.get("client_id") != CLIENT_ID or query.get("redirect_uri") != self.return_address:
            raise ValueError("unknown client or return address")
        challenge = query.get("code_challenge_method") == "S256" and query.get("code_challenge")
        if query.get("response_type") != "code" or "openid" not in query.get("scope", "").split() or not challenge:
            return self._back(query, error="invalid_request")
        age = int(query["max_age"]) if "max_age" in query else None
        too_old = self.present is not None and age is not None and time.time() - self.present[1] >= age
        if self.present is None or too_old or query.get("prompt") == "login":
            self.asked += 1
            if self.person is None:
                return self._back(query, error="access_denied")
            # a person takes longer than a second for a password, a test does not
            self.last_login = max(time.time(), self.last_login + 1)
            self.present = (self.person, self.last_login)
        person, since = self.present
        code = secrets.token_urlsafe(16)
        self.codes[code] = {"person": person, "since": since, "nonce": query.get("nonce"), "challenge": challenge}
        return self._back(query, code=code)

    def _back(self, query: dict[str, str], **answer: str) -> str:
        return f"{self.return_address}?{urlencode(answer | {'state': query.get('state', ''), 'iss': self.issuer})}"

    def token(self, form: dict[str, str], authorization: str) -> tuple[int, dict[str, Any]]:
        """Exchange a code."""
        name, _, secret = base64.b64decode(authorization.removeprefix("Basic ") or "Og==").decode().partition(":")
        if (name, secret) != (CLIENT_ID, self.secret):
            return 401, {"error": "invalid_client"}
        begun = self.codes.pop(form.get("code", ""), None)
        if begun is None or form.get("redirect_uri") != self.return_address or form.get("grant_type") != "authorization_code":
            return 400, {"error": "invalid_grant"}
        shown = _base64(hashlib.sha256(form.get("code_verifier", "").encode()).digest())
        if shown != begun["challenge"]:
            return 400, {"error": "invalid_grant"}
        person, at = begun["person"], int(time.time())
        claims = {"iss": self.issuer, "aud": CLIENT_ID, "sub": person.subject, "iat": at, "exp": at + 300, "auth_time": int(begun["since"])}
        claims |= {"nonce": begun["nonce"], "email": person.email, "email_verified": person.email_verified}
        claims = {k: v for k, v in (claims | self.change).items() if v is not None}
        return 200, {"access_token": secrets.token_urlsafe(), "token_type": "Bearer", "expires_in": 300, "id_token": self._signed(claims)}


def _base64(content: bytes) -> str:
    return base64.urlsafe_b64encode(content).rstrip(b"=").decode()


def _handler(provider: Provider) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            parts = urlsplit(self.path)
            query = {k: v[0] for k, v in parse_qs(parts.query).items()}
            if parts.path == "/.well-known/openid-configuration":
                ways = {"authorization": "authorize", "token": "token", "end_session": "logout"}
                body = {"issuer": provider.issuer, "jwks_uri": f"{provider.issuer}/keys", "response_types_supported": ["code"]}
                self._json(200, body | {f"{k}_endpoint": f"{provider.issuer}/{v}" for k, v in ways.items()})
            elif parts.path == "/keys":
                provider.key_reads += 1
                self._json(200, KeySet(provider.published).as_dict(private=False))
            elif parts.path == "/authorize":
                try:
                    self._sent(provider.authorize(query))
                except ValueError as error:
                    self._json(400, {"error": str(error)})
            elif parts.path == "/logout":
                provider.present = None
                self._sent(query["post_logout_redirect_uri"])
            else:
                self._json(404, {})

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"])).decode()
            form = {k: v[0] for k, v in parse_qs(body).items()}
            self._json(*provider.token(form, self.headers.get("Authorization", "")))

        def _sent(self, address: str) -> None:
            self.send_response(302)
            self.send_header("Location", address)
            self.end_headers()

        def _json(self, status: int, body: dict[str, Any]) -> None:
            content = json.dumps(body).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: Any) -> None:
            pass

    return Handler


@contextmanager
def running(return_address: str) -> Iterator[Provider]:
    """Run a provider that answers as long as the context lasts."""
    provider = Provider(return_address)
    provider.renew_key()
    server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(provider))
    provider.issuer = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield provider
    server.shutdown()
    server.server_close()
    thread.join()
