"""The one rule of what is kept out of training: photographs of the labelled sets, and names."""
import os

HERE = os.path.dirname(os.path.abspath(__file__))


def heldout(index):
    """Whether the photograph `index` of its set (its order in the file, or of its sorted names) is kept out."""
    return index % 10 == 9


def withheld_words():
    """The names of withheld.txt: kept out with all that is a kind of one, where a training withholds names."""
    return {w for row in open(os.path.join(HERE, "withheld.txt")) if not row.startswith("#") for w in row.strip().split(", ") if w}
