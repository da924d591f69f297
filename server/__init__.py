"""The service: `POST /act`, its operation, and the clients that robots use.

What is named here needs numpy and pydantic alone; the service itself is `server.app` and `server.serve`.
"""

from server.async_client import AsyncClient
from server.client import Client
from server.fleet import Fleet
from server.schema import ActReply, ActRequest, ModelReply
from server.session import ClientError, StepError

__all__ = [
    "ActReply",
    "ActRequest",
    "AsyncClient",
    "Client",
    "ClientError",
    "Fleet",
    "ModelReply",
    "StepError",
]
