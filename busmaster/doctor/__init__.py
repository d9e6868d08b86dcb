"""What is wrong with a port, an adapter or a line: examined, and said in words with what to do."""
