"""The robot's side of the service for a control loop in asyncio."""

from __future__ import annotations

import asyncio
import http.client
import ssl
from collections.abc import Sequence
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from decision import Decision, Memory
from server.address import Address
from server.base_client import CONNECT_TIMEOUT, BaseClient
from server.link import MAX_REPLY
from server.session import ClientError, RefusedError, Session, excerpt

_MOST_HEAD = 16384
"""Most bytes of a reply's head."""


class AsyncClient(BaseClient):
    """`server.Client` for asyncio: the same arguments, decisions, faults and hold; https and http alone.

    Connects on entering its context, which raises what the constructor of `Client` does.

        async with AsyncClient("http://127.0.0.1:8000") as client:
            decision = await client.decide(observation, memory=memory)
    """

    def _begin(self, found: Sequence[Address]) -> None:
        self._links = [_Link(address, self._session) for address in found]
        # One robot asks one thing at a time.
        self._turn = asyncio.Lock()

    async def decide(
        self, observation: ArrayLike, hazards: ArrayLike | None = None, memory: Memory | np.void | None = None
    ) -> Decision:
        """`Client.decide`."""
        async with self._turn:
            try:
                return await self._ask(self._session.ask(observation, hazards, memory))
            except Exception as error:  # noqa: BLE001 - whatever it is, the robot needs an action
                return self._session.failed(error, self._timeout)

    async def resume(self) -> None:
        """`Client.resume`."""
        async with self._turn:
            self.close()
            with self._session.anew():
                await self._connect()

    def close(self) -> None:
        """Closes the connections."""
        for link in self._links:
            link.close()

    async def __aenter__(self) -> Self:
        """The client, connected."""
        await self._connect()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the connections."""
        self.close()

    async def _connect(self) -> None:
        """Connects to all that answer; whoever does not may do so later."""
        fault: ClientError | None = None
        try:
            for link in self._links:
                try:
                    async with asyncio.timeout(CONNECT_TIMEOUT):
                        await link.connect()
                except ClientError:
                    raise
                except Exception as error:  # noqa: BLE001 - the caller was promised a ClientError
                    fault = ClientError(f"{link.url}: {excerpt(str(error) or type(error).__name__)}")
                    fault.__cause__ = error
            if self._session.met is None:
                raise fault or ClientError("no service was named")
        except BaseException:
            self.close()
            raise

    async def _ask(self, body: bytes) -> Decision:
        """The first good reply of a service; whoever gives none is asked last from then on."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + self._timeout
        for left in range(len(self._links), 0, -1):
            link = self._links[0]
            try:
                async with asyncio.timeout((deadline - loop.time()) / left):
                    return self._session.told(*await link.exchange("POST", "/act", body))
            except RefusedError:
                link.close()
                raise
            except Exception:
                link.close()
                self._links.append(self._links.pop(0))
                if left == 1:
                    raise
            except BaseException:
                link.close()
                raise
        raise ClientError("no service was named")


class _Link:
    """`server.link.Link` on asyncio's streams; who calls it bounds the time."""

    def __init__(self, address: Address, session: Session) -> None:
        if address.streams:
            raise ClientError(f"{address.url}: an AsyncClient asks over http or https")
        self.url = address.url
        self._address = address
        self._session = session
        host = f"[{address.host}]" if ":" in address.host else address.host
        headers = {"host": f"{host}:{address.port}", **address.headers}
        self._headers = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
        self._open: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def connect(self) -> None:
        """Opens the connection, and looks at who is there."""
        if self._open is not None:
            return
        tls: ssl.SSLContext | None = self._address.tls
        self._open = await asyncio.open_connection(
            self._address.host, self._address.port, ssl=tls, limit=_MOST_HEAD
        )
        self._session.meet(self.url, *await self._exchange(*self._open, "GET", "/model", b""))

    async def exchange(self, method: str, path: str, body: bytes) -> tuple[int, bytes]:
        """One request and its reply: status and body."""
        kept = self._open
        # It was closed while it was idle, or something came that nobody had asked for.
        if kept is not None and (kept[0].at_eof() or kept[0]._buffer):  # type: ignore[attr-defined]
            self.close()
        await self.connect()
        if self._open is None:
            raise ConnectionResetError("the service closed the connection")
        return await self._exchange(*self._open, method, path, body)

    def close(self) -> None:
        """Closes the connection."""
        if self._open is not None:
            self._open[1].close()
            self._open = None

    async def _exchange(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        method: str,
        path: str,
        body: bytes,
    ) -> tuple[int, bytes]:
        head = f"{method} {path} HTTP/1.1\r\n{self._headers}content-length: {len(body)}\r\n\r\n"
        writer.write(head.encode("latin-1") + body)
        try:
            told = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower().split("\r\n")
            status, length, closes = _read_head(told)
            content = await reader.readexactly(length)
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError) as error:
            raise http.client.HTTPException("the reply is not whole") from error
        if closes:
            self.close()
        return status, content


def _read_head(lines: Sequence[str]) -> tuple[int, int, bool]:
    """Status, length of the body, and whether the connection ends after it.

    Raises:
        http.client.HTTPException: if it is no head, or states no length that a reply can have.
    """
    words = lines[0].split(" ")
    if not words[0].startswith("http/1.") or len(words) < 2 or not words[1].isdigit():
        raise http.client.HTTPException(f"no HTTP: {excerpt(lines[0])}")
    headers = [line.partition(":")[::2] for line in lines[1:]]
    lengths = [value.strip() for name, value in headers if name == "content-length"]
    encoded = any(name == "transfer-encoding" for name, _ in headers)
    # isdigit alone takes other scripts' digits, and int() refuses thousands of them.
    sound = len(lengths) == 1 and lengths[0].isascii() and lengths[0].isdigit() and len(lengths[0]) < 9
    if not sound or encoded or int(lengths[0]) > MAX_REPLY:
        raise http.client.HTTPException("the reply states no length that a reply can have")
    closes = any(name == "connection" and value.strip() == "close" for name, value in headers)
    return int(words[1][:4]), int(lengths[0]), closes
