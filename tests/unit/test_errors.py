"""The errors a user can meet, as their module draws them."""

import pickle
import re

import pytest

from dsar import errors


def every(kind):
    return [each for below in kind.__subclasses__() for each in (below, *every(below))]


def test_the_drawn_tree_is_the_real_one():
    drawn = re.findall(r"── (\w+) +\((\w+)\)", errors.__doc__)
    real = [(each.__name__, each.__mro__[2].__name__) for each in every(errors.DsarError)]
    assert len(set(drawn)) == len(drawn)
    assert set(drawn) == set(real)


@pytest.mark.parametrize("kind", every(errors.DsarError))
def test_errors_come_out_of_other_processes_with_their_words(kind):
    error = kind("feature", "package", "extra") if kind is errors.MissingDependencyError else kind("words")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert str(again) == str(error)
