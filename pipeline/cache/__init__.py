"""Never compute twice: the identity of a computation, and a store of results by it."""
