"""HTTP requests with bounds on time and size, for the MockBoard and the simulated head.

No redirects, no proxies from the environment, no cookies: the adapters speak to one named address only.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Mapping
from typing import Any

import httpx

from engine_adapters.errors import AdapterError, ProtocolError, TimedOut, Unreachable


class BoundedHttp:
    """A keep-alive client whose every request ends in (status, body) or a typed error."""

    def __init__(
        self,
        *,
        what: str,
        hint: str,
        connect_timeout_s: float,
        timeout_s: float,
        limit_bytes: int,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        self._what = what
        self._hint = hint
        self._timeout_s = timeout_s
        self._connect_timeout_s = connect_timeout_s
        self._limit_bytes = limit_bytes
        self._closed = False
        self._headers = dict(headers or {})
        self._client: httpx.AsyncClient | None = None

    async def request(self, method: str, url: str, *, json: Any = None) -> tuple[int, bytes]:
        """One request. Raises ``Unreachable``, ``TimedOut``, ``ProtocolError``; its connection is closed with them."""
        where = f"{self._what} at {url}"
        if self._closed:
            raise Unreachable("this client was closed", where=where)
        try:
            # httpx bounds each wait by itself: a byte now and then would keep it waiting for ever.
            async with asyncio.timeout(self._timeout_s):
                return await self._exchange(method, url, json, where)
        except TimeoutError as error:
            raise TimedOut(f"{method} {url}", self._timeout_s, where=self._what) from error
        except httpx.ConnectTimeout as error:
            raise TimedOut("the connection", self._connect_timeout_s, where=where) from error
        except httpx.TimeoutException as error:
            raise TimedOut(f"{method} {url}", self._timeout_s, where=self._what) from error
        except httpx.RemoteProtocolError as error:
            raise self._broken(error, where) from error
        except httpx.NetworkError as error:
            raise Unreachable(f"no connection ({error}); {self._hint}", where=where) from error
        except httpx.DecodingError as error:
            raise ProtocolError(f"the answer cannot be unpacked ({error})", where=where) from error
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise Unreachable(f"{error}; {self._hint}", where=where) from error

    async def close(self) -> None:
        """Close the connections. Safe to call twice."""
        self._closed = True
        if self._client is not None:
            await self._client.aclose()

    async def _connected(self, url: str) -> httpx.AsyncClient:
        if self._client is None:
            # Reading the system's certificates takes a tenth of a second, which the event loop does not have; without
            # TLS nothing is verified, so none are read.
            tls = url.lower().startswith("https:")
            context = await asyncio.to_thread(ssl.create_default_context) if tls else False
            self._client = httpx.AsyncClient(
                headers=self._headers,
                timeout=httpx.Timeout(self._timeout_s, connect=self._connect_timeout_s),
                # One connection in use and one to spare, so that a decode never holds up the next fetch.
                limits=httpx.Limits(max_connections=2, max_keepalive_connections=2),
                follow_redirects=False,
                trust_env=False,
                verify=context,
            )
        return self._client

    async def _exchange(self, method: str, url: str, json: Any, where: str) -> tuple[int, bytes]:
        client = await self._connected(url)
        async with client.stream(method, url, json=json) as response:
            body = bytearray()
            async for chunk in response.aiter_bytes():
                body += chunk
                if len(body) > self._limit_bytes:
                    raise ProtocolError(
                        f"the answer is larger than its limit of {self._limit_bytes} bytes", where=where
                    )
            return response.status_code, bytes(body)

    def _broken(self, error: httpx.RemoteProtocolError, where: str) -> AdapterError:
        # httpx tells a lost connection and a nonsensical answer by the same type.
        if any(word in str(error) for word in ("disconnected", "closed connection", "ConnectionClosed")):
            return Unreachable(f"the connection was lost in the middle of the answer ({error})", where=where)
        return ProtocolError(f"the answer is not HTTP ({error}); check the address and its port", where=where)
