"""Settings that every test shares; they must be in place before numpy is imported."""

from pipeline import numeric

numeric.settle()
