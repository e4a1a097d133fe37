"""A viewer in the browser: pictures of trained avatars, made on request by one thread, shown by viser."""
