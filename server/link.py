"""One HTTP connection with a deadline over the whole exchange.

HTTP libraries bound each read, so that a service which sends a byte now and then holds the caller for as long
as it likes. Here whatever is left of the deadline bounds the next read.
"""

from __future__ import annotations

import http.client
import socket
import ssl
import time
from collections.abc import Callable
from typing import Any, cast

MAX_REPLY = 256 * 1024
"""Most bytes of a reply, its head included; a real one has one or two thousand."""


class _Bounded:
    """Reads that end at one deadline and after so many bytes, however many reads there are.

    Attributes:
        deadline: when they end, on the clock of `time.monotonic` [s].
        allowance: how many bytes may still come.
    """

    deadline = 0.0
    allowance = 0

    def count(self, received: int) -> int:
        """Takes note of what has come.

        Raises:
            http.client.HTTPException: once more has come than is allowed.
        """
        self.allowance -= received
        if self.allowance < 0:
            raise http.client.HTTPException(f"the reply has more than {MAX_REPLY} bytes")
        return received


class DeadlineSocket(_Bounded, socket.socket):
    """A socket with such reads."""

    def recv_into(self, *arguments: Any) -> int:
        """Reads what is there.

        Raises:
            TimeoutError: once the deadline has passed.
            http.client.HTTPException: once more has come than is allowed.
        """
        self.settimeout(remaining(self.deadline))
        return self.count(super().recv_into(*arguments))


class DeadlineTLSSocket(_Bounded, ssl.SSLSocket):
    """A socket with such reads that speaks TLS."""

    def recv_into(self, *arguments: Any) -> int:
        """Reads what is there, as `DeadlineSocket`."""
        self.settimeout(remaining(self.deadline))
        return self.count(super().recv_into(*arguments))


Connected = DeadlineSocket | DeadlineTLSSocket
Greet = Callable[[int, bytes], None]
"""Is given status and body of the answer to `GET /model`, and raises if it is not to be followed."""


class Link:
    """A connection that is opened when needed, kept, and opened anew after any fault.

    The host's name is looked up once, by the first exchange: a look-up knows no deadline.

    Args:
        host: whom to connect to.
        port: where.
        headers: sent with every request.
        greet: looks at what every new connection's other side says of itself, before anything else is asked.
        tls: by which the other side is verified; None: the connection is plain.
    """

    def __init__(
        self,
        host: str,
        port: int,
        headers: dict[str, str],
        greet: Greet | None = None,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._address = (host, port)
        name = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self._headers = "".join(f"{key}: {value}\r\n" for key, value in {"host": name, **headers}.items())
        self._addresses: list[tuple[Any, ...]] = []
        self._socket: Connected | None = None
        self._greet = greet
        self._tls = tls
        if tls is not None:
            tls.sslsocket_class = DeadlineTLSSocket

    def connect(self, timeout: float) -> None:
        """Opens the connection, as the first exchange would.

        Args:
            timeout: how long it may take [s].

        Raises:
            TimeoutError, OSError, http.client.HTTPException: as `exchange`.
        """
        if self._socket is None:
            try:
                self._open(time.monotonic() + timeout)
            except BaseException:
                self.close()
                raise

    def exchange(self, method: str, path: str, body: bytes, timeout: float) -> tuple[int, bytes]:
        """One request and its reply.

        Args:
            method: "GET" or "POST"; it must be safe to send twice.
            path: the path.
            body: what to send.
            timeout: how long connecting, sending and reading may take altogether [s].

        Returns:
            Status and body.

        Raises:
            TimeoutError: if it takes longer.
            OSError: if the connection fails.
            http.client.HTTPException: if the reply is not HTTP, does not state its length, or is longer than
                `MAX_REPLY`.
        """
        deadline = time.monotonic() + timeout
        if self._socket is not None and not _silent(self._socket):
            # It was closed while it was idle, or something came that nobody had asked for: a reply to a
            # request that is still to be sent would otherwise be taken for one.
            self.close()
        kept = self._socket is not None
        try:
            return self._exchange(method, path, body, deadline)
        except ConnectionError:
            # The other side may have closed a kept connection while it was idle; a fresh one is tried once.
            if not kept:
                raise
        return self._exchange(method, path, body, deadline)

    def close(self) -> None:
        """Closes the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _exchange(self, method: str, path: str, body: bytes, deadline: float) -> tuple[int, bytes]:
        try:
            opened = self._socket or self._open(deadline)
            return self._transfer(opened, method, path, body, deadline)
        except BaseException:
            # Half an exchange may be left in it: the next reply would be the answer to this request. Also on
            # Ctrl-C, after which the robot may still be brought to a stop.
            self.close()
            raise

    def _open(self, deadline: float) -> Connected:
        """Opens a connection, and looks at who is there."""
        opened = self._connect(deadline)
        if self._greet is not None:
            self._greet(*self._http(opened, "GET", "/model", b"", deadline))
        return self._socket or self._connect(deadline)

    def _transfer(
        self, opened: Connected, method: str, path: str, body: bytes, deadline: float
    ) -> tuple[int, bytes]:
        """Sends one request over an open connection and reads its reply."""
        return self._http(opened, method, path, body, deadline)

    def _http(
        self, opened: Connected, method: str, path: str, body: bytes, deadline: float
    ) -> tuple[int, bytes]:
        # Head and body leave in one packet; http.client would send two.
        head = f"{method} {path} HTTP/1.1\r\n{self._headers}content-length: {len(body)}\r\n\r\n"
        opened.deadline, opened.allowance = deadline, MAX_REPLY
        opened.settimeout(remaining(deadline))
        opened.sendall(head.encode("latin-1") + body)
        response = http.client.HTTPResponse(opened, method=method)
        response.begin()
        # The service states the length of whatever it sends. What does not is not read: a chunk may
        # claim any size.
        if response.length is None or response.length > MAX_REPLY:
            raise http.client.HTTPException("the reply states no length that a reply can have")
        content = response.read()
        if response.will_close:
            self.close()
        return response.status, content

    def _connect(self, deadline: float) -> Connected:
        """Opens a connection to the first of the host's addresses that answers: "localhost" often has two."""
        if not self._addresses:
            self._addresses = list(socket.getaddrinfo(*self._address, type=socket.SOCK_STREAM))
        fault: OSError | None = None
        for k, found in enumerate(self._addresses):
            try:
                self._socket = self._reach(found, remaining(deadline) / (len(self._addresses) - k))
            except OSError as error:
                fault = error
                continue
            # Asked first the next time.
            self._addresses.sort(key=lambda address: address != found)
            return self._socket
        raise fault or OSError("the host has no address")

    def _reach(self, found: tuple[Any, ...], timeout: float) -> Connected:
        deadline = time.monotonic() + timeout
        opened = _open(found, timeout)
        if self._tls is None:
            return opened
        try:
            opened.settimeout(remaining(deadline))
            return cast(DeadlineTLSSocket, self._tls.wrap_socket(opened, server_hostname=self._address[0]))
        except BaseException:
            opened.close()
            raise


def _open(found: tuple[Any, ...], timeout: float) -> DeadlineSocket:
    family, kind, protocol, _, address = found
    opened = DeadlineSocket(family, kind, protocol)
    try:
        opened.settimeout(timeout)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        opened.connect(address)
    except BaseException:
        opened.close()
        raise
    return opened


def _silent(connection: socket.socket) -> bool:
    """Whether nothing has come that was not read, the other side's end included."""
    connection.setblocking(False)
    try:
        connection.recv(1)
    except (BlockingIOError, ssl.SSLWantReadError):
        return True
    except OSError:
        pass
    return False


def remaining(deadline: float) -> float:
    """What is left until a deadline [s].

    Raises:
        TimeoutError: if nothing is.
    """
    left = deadline - time.monotonic()
    if left <= 0.0:
        raise TimeoutError("the deadline has passed")
    return left
