"""Every exception this project raises on purpose. The message says what was expected, what came, what to do."""


class RelodError(Exception):
    """Base of all errors of this project."""


class ConfigError(RelodError, ValueError):
    """A configuration file, a ``--set`` option or a table entry is wrong; the message names key and value."""


class MessageError(RelodError, ValueError):
    """A received message cannot be used: wrong bytes, type, shape, dtype, bounds, or not finite."""


class SchemaVersionError(MessageError):
    """A message was written by a peer with another version of the message schema."""


class TransportError(RelodError):
    """The network session cannot be opened or used."""


class EndpointInUseError(TransportError):
    """Another process already listens on the endpoint."""


class RingError(RelodError):
    """The experience ring's file cannot be created, opened or trusted."""


class ServiceError(RelodError):
    """A service cannot go on; it ends with exit code 1 and this message."""


class CameraError(ServiceError):
    """A camera cannot be opened, or what it shows cannot be used."""
