"""What the tests of the commands share."""

from eha_monitor.cli import main


def refused(capture, *words) -> str:
    """Run a command that must end with status 2, and return the one line that it says.

    ``capture`` is ``capsys`` or ``capfd``; nothing may be left in it from before.
    """
    assert main([str(word) for word in words]) == 2
    out, err = capture.readouterr()
    ours = [line for line in err.splitlines(True) if not line.startswith("[")]  # the log of ROS
    assert len(ours) == 1 and "Traceback" not in out + err, err
    assert ours[0].startswith("eha_monitor: ")
    return ours[0]
