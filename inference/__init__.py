"""What a bundle's networks say of an observation: the nominal action and the risk score."""

from inference.errors import NetworkError
from inference.networks import Networks

__all__ = ["NetworkError", "Networks"]
