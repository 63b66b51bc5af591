"""What can go wrong with an emulated link, so that a launcher can tell it from other errors."""

from common.errors import RelodError


class LinkUnavailable(RelodError):
    """This kind of link cannot be opened here. The message says why, and what to do about it."""


class LinkFailedError(RelodError):
    """A link that was open does not answer any more, or was asked for a way it does not have."""
