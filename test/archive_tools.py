"""What runs in a process of its own: a module that takes no time to import."""

import os


def killed_by_three(number: int) -> int:
    if number == 3:
        os._exit(9)
    return number * number
