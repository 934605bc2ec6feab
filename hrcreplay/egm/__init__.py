"""The EGM link: message codec, our side of the protocol, UDP server, and a robot double for tests."""
