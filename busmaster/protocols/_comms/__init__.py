"""What HCP and HCP2 share: numbered elements of a comms array, and the controllers that have one."""
