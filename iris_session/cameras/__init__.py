"""Pictures of the cameras of a session's model, drawn in a process of their own and published as media streams."""
