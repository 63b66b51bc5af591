"""Where the parts of a learning system run: what each distribution makes of learning, in virtual time."""
