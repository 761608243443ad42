"""Errors that a user can fix."""


class DuagError(Exception):
    """One line that names the file, the topic, what was found and what was expected.

    The command line prints the line and exits with 1; anything else that is raised is a bug.
    """
