"""What is on a cable of which nothing is known: its rate, framing and protocols, and the nodes."""
