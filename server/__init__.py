"""The service: `POST /act`, its operation, and the clients that robots use.

What is named here needs numpy and pydantic alone; the service itself is `server.app` and `server.serve`.
"""

from server.client import Client, ClientError
from server.fleet import Fleet
from server.schema import ActReply, ActRequest, ModelReply

__all__ = ["ActReply", "ActRequest", "Client", "ClientError", "Fleet", "ModelReply"]
