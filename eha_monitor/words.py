"""Names and lists as people say them."""


def effect_words(name: str) -> str:
    """Return the name of an effect as people say it: ``Coulomb friction``."""
    words = name.replace("_", " ")
    words = words.replace("one sided", "one-sided")
    for person in ("coulomb", "stribeck"):
        words = words.replace(person, person.capitalize())
    return words


def listed(words: list[str] | tuple[str, ...], last: str = "and") -> str:
    """Return ``a, b and c``."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"
