"""What a user holds: the bus, its nodes, points, poll groups, and handles' common base."""
