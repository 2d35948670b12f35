"""What the page has done in other processes: functions of plain values, without a framework."""


def prepare() -> None:
    """What a process loads before its first job: modules of the first jobs of a session, and one
    law's functions.
    """
    from ...muscles.catalogue import muscle
    from . import data, plant
    from . import muscle as fits

    assert all((data, fits, plant))  # loading them is what is wanted
    muscle("DMSP-20-300").force(3e5, 0.1)
