"""What a scene may call for beyond emission and absorption: light, and what surfaces and the medium make of it."""
