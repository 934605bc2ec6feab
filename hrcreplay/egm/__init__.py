"""The link to the robot: messages, our side of the conversation, the socket, and a robot double to try them on."""
