"""What can stop training, each with one clear line for the user."""


class TrainerError(Exception):
    """Anything that stops training or export and that the user can act on."""


class ConfigError(TrainerError):
    """A setting, or a combination of settings, makes no sense."""


class CheckpointError(TrainerError):
    """A run folder or a checkpoint cannot be written, read or continued."""


class NonFiniteError(TrainerError):
    """A loss or a statistic became NaN or infinite; the message names the term."""


class ExportError(TrainerError):
    """A run cannot be turned into a bundle."""
