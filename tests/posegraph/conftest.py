"""Robots of the box world, as the tests of the exchange have them."""

from tests.exchange.conftest import make_robot as make_robot
