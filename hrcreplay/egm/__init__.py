"""The EGM link: message codec, client side of the protocol, UDP server, and a robot double for tests."""
