"""Why a run of a program gave no prediction: the reason of a failed member."""


class ProgramError(Exception):
    """A program ended badly, or what it left cannot be read; the words are the member's reason."""
