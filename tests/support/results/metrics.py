"""Names of stored figures as the quantity, statistic and aim that a metric has."""

from processor.model import BETTER, Better, Metric, Statistic

HIGH = ("nodes found", "recall", "share of the sky")


def described(name):
    """The quantity, statistic and aim of a figure of that name."""
    for statistic in Statistic:
        head = Metric("\0", 0.0, statistic).name.split("\0")[1]
        if head and name.endswith(head):
            return name.removesuffix(head), statistic, BETTER.get(statistic, Better.LOW)
    return name, Statistic.VALUE, Better.HIGH if any(word in name for word in HIGH) else Better.LOW


def metric(name, value, limit=float("nan"), unit="mm", step="s", method=""):
    """A metric of a name."""
    quantity, statistic, better = described(name)
    return Metric(quantity, value, statistic, unit, limit, better, step, method)
