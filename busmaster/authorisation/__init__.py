"""What comes from outside passes here: permission, freshness, a bound on how much waits, and a record of each write.

Limits are held further in, at the node, where no way of writing goes round them.
"""
