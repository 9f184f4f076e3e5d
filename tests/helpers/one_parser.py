"""One parser for all command lines of a process: it depends on the verb alone, and takes long to build."""

KEPT = ("parser", "_subcommand_parsers", "_subcommand_method_arguments")


def share_parsers() -> None:
    """Have each verb's parser built once."""
    from lightning.pytorch.cli import LightningCLI

    kept: dict[str, dict] = {}
    build = LightningCLI.setup_parser

    def setup_parser(self, *args, **kwargs):
        if self.verb not in kept:
            build(self, *args, **kwargs)
            kept[self.verb] = {name: getattr(self, name) for name in KEPT}
        vars(self).update(kept[self.verb])
        vars(self.parser).pop("print_config", None)  # of a command that was refused before it printed any

    LightningCLI.setup_parser = setup_parser
