"""Codecs of everything that agents send: structures to bytes and back, checked as they are read."""
