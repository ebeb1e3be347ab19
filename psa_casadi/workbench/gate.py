"""Who may ask the local page for something: whoever has its address, from the page itself."""

import hmac
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie

#: The name of the machine for itself, as addresses have it.
HOST = "127.0.0.1"
#: What a browser says of a request that the page itself, or nobody else's page, has caused.
_OWN = ("same-origin", "none")


@dataclass(frozen=True)
class Gate:
    """What opens a page at a port: a token in the address, then a cookie.

    The cookie is no part of an address, no script can read it, and a browser sends it with nothing
    that another site has caused. The names of the machine are a fixed list, so that a name of
    somebody else which leads to this machine (DNS rebinding) opens nothing.
    """

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    _session: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    @property
    def address(self) -> str:
        """The address that opens the page."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    @property
    def cookie(self) -> str:
        """What a browser is given to keep."""
        return f"{self._name}={self._session}; HttpOnly; SameSite=Strict; Path=/"

    @property
    def _name(self) -> str:
        return f"psa_{self.port}"  # browsers have one set of cookies for all ports

    def opens(self, token: str) -> bool:
        """Whether an address's token is the right one."""
        return _same(token, self.token)

    def refused(self, method: str, headers: Mapping[str, str]) -> tuple[HTTPStatus, str] | None:
        """Return why a request is refused, before its cookie is looked at; None where it is not."""
        hosts = [f"{name}:{self.port}" for name in (HOST, "localhost")]
        host = headers.get("Host", "")
        if host not in hosts:
            return HTTPStatus.MISDIRECTED_REQUEST, "This page has another address."
        if method == "POST" and headers.get("Origin", "") != f"http://{host}":
            return HTTPStatus.FORBIDDEN, "Only the page itself may ask for this."
        return None

    def knows(self, headers: Mapping[str, str]) -> bool:
        """Whether a request has the cookie and is not caused by another site."""
        if headers.get("Sec-Fetch-Site", "none") not in _OWN:
            return False
        try:
            found = SimpleCookie(headers.get("Cookie", "")).get(self._name)
        except CookieError:
            return False
        return found is not None and _same(found.value, self._session)


def _same(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(), other.encode())
