"""A room in the browser: pictures of a run under any camera and light, refined while one waits."""
