"""What a user of S3 sets before a command."""

import os


def as_a_user(monkeypatch, endpoint, **more):
    """Set the environment for `endpoint` and whatever else; None leaves one out."""
    import s3fs

    keys = {"AWS_ACCESS_KEY_ID": "user", "AWS_SECRET_ACCESS_KEY": "secret"}
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    settings = {"AWS_ENDPOINT_URL": endpoint, "AWS_DEFAULT_REGION": "us-east-1", **keys, **more}
    for name, value in settings.items():
        if value is not None:
            monkeypatch.setenv(name, value)
    # What was reached before is remembered by its arguments, not by the environment.
    s3fs.S3FileSystem.clear_instance_cache()
