"""Where webhooks may go. A user chooses the address, so the server must not be led into its own network by it.

The name is resolved once, every address that it has must be a global one (or in a network that the operator allowed),
and the connection goes to the address that was checked: a name that means something else a moment later changes
nothing.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import SplitResult, urlsplit

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network
UNICAST = ipaddress.IPv6Network("2000::/3")  # what is given out; whatever else Python's `is_global` may say of the rest
NAT64 = ipaddress.IPv6Network("64:ff9b::/96")  # its last 32 bits are an IPv4 address: what DNS64 makes of a public name


class TargetRefused(Exception):
    """The address is none that webhooks may go to; the message says why."""


@dataclass(frozen=True, slots=True)
class Target:
    """A checked address. `url` has the address instead of the name; `host` is the name, for `Host` and TLS."""

    url: str
    host: str
    host_header: str


@dataclass(frozen=True, slots=True)
class TargetRules:
    """allow_http: also without TLS. networks: allowed although they are not global."""

    allow_http: bool = False
    networks: Sequence[Network] = ()

    def check_url(self, url: str) -> SplitResult:
        """TargetRefused if it can be seen without resolving the name that the URL is none for webhooks."""
        try:
            parts = urlsplit(url)
            port = parts.port
        except ValueError as error:
            raise TargetRefused(f"it is no URL: {error}") from None
        if parts.scheme != "https" and not (parts.scheme == "http" and self.allow_http):
            raise TargetRefused("it must start with https://")
        if not parts.hostname or port == 0 or parts.username is not None or parts.password is not None:
            raise TargetRefused("it must name a host, and neither user nor password")
        if not url.isascii() or not url.isprintable() or any(c in url for c in ' \\"<>'):
            raise TargetRefused("it must be plain ASCII; percent-encode the rest")
        return parts

    def resolve(self, url: str) -> Target:
        """Look the name up, once. TargetRefused also when it has no address. Blocks."""
        parts = self.check_url(url)
        host = parts.hostname or ""
        port = parts.port or (443 if parts.scheme == "https" else 80)
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            raise TargetRefused(f"the name {host!r} cannot be resolved: {error}") from None
        addresses = [ipaddress.ip_address(str(entry[4][0]).partition("%")[0]) for entry in found]
        for address in addresses:
            if not self._is_allowed(address):
                raise TargetRefused(f"{host!r} has the address {address}, which is not a public one")
        pinned = f"[{addresses[0]}]" if addresses[0].version == 6 else str(addresses[0])
        return Target(
            url=parts._replace(netloc=f"{pinned}:{port}", fragment="").geturl(),
            host=host,
            host_header=parts.netloc,
        )

    def _is_allowed(self, address: Address) -> bool:
        if any(address.version == network.version and address in network for network in self.networks):
            return True
        if address.version == 6 and address not in UNICAST and address not in NAT64:
            return False
        return all(inner.is_global and not inner.is_multicast for inner in (address, *_embedded(address)))


def _embedded(address: Address) -> list[ipaddress.IPv4Address]:
    """IPv4 addresses that routers or kernels would take out of an IPv6 one."""
    if address.version == 4:
        return []
    assert isinstance(address, ipaddress.IPv6Address)
    found = [address.sixtofour, *(address.teredo or ())]
    if address in NAT64:
        found.append(ipaddress.IPv4Address(int(address) & 0xFFFFFFFF))
    return [inner for inner in found if inner is not None]
