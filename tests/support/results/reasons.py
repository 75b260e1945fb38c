"""Reasons with those in their values."""

from processor.model import Reason


def flat(message):
    """All reasons in a reason, or in a list of reasons, each before those in its values."""
    if isinstance(message, Reason):
        return [message, *flat(list(message.values.values()))]
    return [one for inner in message for one in flat(inner)] if isinstance(message, list | tuple) else []


def codes(message):
    return [one.code for one in flat(message)]


def values(message, code):
    """The values of the first reason with a code."""
    return next(one.values for one in flat(message) if one.code == code)
