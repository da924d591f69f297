"""The service: `POST /act`, its operation, and the client a robot uses."""

from server.app import create_app
from server.client import Client, ClientError
from server.schema import ActReply, ActRequest, ModelReply

__all__ = ["ActReply", "ActRequest", "Client", "ClientError", "ModelReply", "create_app"]
