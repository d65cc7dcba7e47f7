"""Numbers with their nouns, in singular or plural."""


def counted(number: int, noun: str) -> str:
    """The number with thousands separated, and the noun in the right number.

    >>> counted(1, "block"), counted(0, "block"), counted(1_200, "entry"), counted(2, "switch")
    ('1 block', '0 blocks', '1,200 entries', '2 switches')
    """
    if number == 1:
        return f"1 {noun}"
    if noun.endswith("y"):
        return f"{number:,} {noun[:-1]}ies"
    return f"{number:,} {noun}es" if noun.endswith(("s", "ch")) else f"{number:,} {noun}s"
