"""The robot's side of the service: it always has an action, whatever happens to the other side."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from decision import Decision, Memory
from server.address import Address
from server.base_client import CONNECT_TIMEOUT, DEFAULT_TIMEOUT, BaseClient
from server.link import Link, remaining
from server.session import ClientError, RefusedError, Session, excerpt
from server.stream import StreamLink

__all__ = ["CONNECT_TIMEOUT", "DEFAULT_TIMEOUT", "Client", "ClientError"]


class Client(BaseClient):
    """One robot's connection to the service, with the `decide` of `monitor.Monitor`.

    `decide` raises nothing that comes from the service, the network or its arguments. Where it gets no good
    reply it decides by itself: the plan in the robot's memory goes on for as long as it lasts, then the robot
    coasts. After `most_failures` of these in a row it holds: it asks no more, and goes on so until `resume`.

    Args:
        url: the service, for example "http://127.0.0.1:8000"; "ws://..." asks over `WS /act/stream`, "https"
            and "wss" verify the other side. Several: where one fails, the next is asked within the same
            time-out; all must run the same, and take each other's memories (`--memory-key-file`).
        observation_layout: what this robot sends, as `pointgoal.observation.layout(level).to_json()`;
            compared with the service's before the robot moves. None compares each observation's length alone.
        timeout: how long `decide` may take, whatever the service sends meanwhile [s]; by default a control
            step of 20 ms. A service that is far away or still warming up takes longer: its late replies are
            so many fallbacks. Connecting here may take 5 s; the host's name is looked up here, once.
        api_key: sent as `Authorization: Bearer`.
        robot: the robot's name. The service then knows a memory that is not its last, and a sensor that was
            caught stays so until it is told otherwise. None: both hold until a step without memory alone.
        most_failures: failures in a row after which it holds; None: never. By default half a second's.
        raises: raise `server.session.StepError`, which carries the fallback, instead of returning it.
        clock: the robot's clock [s], which stamps every request at `decide`; for a service that looks at
            stamps. None: none is sent.
        ca_file: certificates by which https is verified; None: the system's.

    Attributes:
        faults: what went wrong so far.

    Raises:
        ClientError: if no service answers, or one's observation layout is another, or two run different
            things.
        ValueError: if the timeout is not finite and positive, the key is not printable ASCII, or
            `most_failures` is below 1.
    """

    def _begin(self, found: Sequence[Address]) -> None:
        self._links = [(address, _link(address, self._session)) for address in found]
        self._connect()

    def decide(
        self,
        observation: ArrayLike,
        hazards: ArrayLike | None = None,
        memory: Memory | np.void | None = None,
    ) -> Decision:
        """Asks the service to decide.

        Args:
            observation: (O,), in the service's layout.
            hazards: (n, 2), centres in the body frame [m]; None or none at all: what the lidar shows.
            memory: the `memory` of this robot's last decision, the client's own included; None before its
                first.

        Returns:
            The service's decision. Where there is none: mode "fallback", origin "plan", opened by "fault",
            and the reason.
        """
        try:
            return self._ask(self._session.ask(observation, hazards, memory))
        except Exception as error:  # noqa: BLE001 - whatever it is, the robot needs an action
            return self._session.failed(error, self._timeout)

    def resume(self) -> None:
        """Ends a hold, and connects anew: what the service runs by now is taken, if the robot fits it.

        Raises:
            ClientError: as the constructor; it goes on holding.
        """
        self.close()
        with self._session.anew():
            self._connect()

    def close(self) -> None:
        """Closes the connections."""
        for _, link in self._links:
            link.close()

    def __enter__(self) -> Self:
        """The client itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the connections."""
        self.close()

    def _connect(self) -> None:
        """Connects to all that answer; whoever does not may do so later."""
        fault: ClientError | None = None
        try:
            for address, link in self._links:
                fault = self._try(address, link) or fault
            if self._session.met is None:
                raise fault or ClientError("no service was named")
        except BaseException:
            self.close()
            raise

    def _try(self, address: Address, link: Link) -> ClientError | None:
        try:
            link.connect(CONNECT_TIMEOUT)
        except ClientError:
            raise
        except Exception as error:  # noqa: BLE001 - whatever it is, the caller was promised a ClientError
            fault = ClientError(f"{address.url}: {excerpt(str(error) or type(error).__name__)}")
            fault.__cause__ = error
            return fault
        return None

    def _ask(self, body: bytes) -> Decision:
        """The first good reply of a service; whoever gives none is asked last from then on."""
        deadline = time.monotonic() + self._timeout
        for left in range(len(self._links), 0, -1):
            link = self._links[0][1]
            try:
                share = remaining(deadline) / left
                return self._session.told(*link.exchange("POST", "/act", body, share))
            except RefusedError:
                link.close()
                raise
            except Exception:
                # Whoever sends one wrong reply may have others under way.
                link.close()
                self._links.append(self._links.pop(0))
                if left == 1:
                    raise
            except BaseException:
                link.close()
                raise
        raise ClientError("no service was named")


def _link(address: Address, session: Session) -> Link:
    def greet(status: int, content: bytes) -> None:
        session.meet(address.url, status, content)

    kind = StreamLink if address.streams else Link
    return kind(address.host, address.port, address.headers, greet, address.tls)
