"""What runs in a process of its own: a module that takes no time to import."""

import os


def killed_by_three(number: int) -> int:
    if number == 3:
        os._exit(9)
    return number * number


def here(function, tasks, jobs, alone=0, asked=None):
    """Make the answers in this process, in place of ``on_this_machine``."""
    for task in tasks:
        if asked is not None:
            asked.append(task.name)
        yield task, function(task), ""
