"""The one rule of what labelled photographs are kept out of training."""


def heldout(index):
    """Whether the photograph `index` of its set (its order in the file, or of its sorted names) is kept out."""
    return index % 10 == 9
