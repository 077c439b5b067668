"""Lifting: joints in a picture become joints in metres, by networks that see only the joints."""
