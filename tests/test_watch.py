"""What a run reports while it is computed."""

from duagc.pipeline.watch import Watch


def test_the_end_of_a_part_is_reported_however_soon_it_comes():
    heard = []
    report = Watch(heard.append).frontend("alpha", 0)
    for done in (1, 2, 3):
        report("final", done, 3, None)
    assert heard == [("alpha", "final", 1, 3), ("alpha", "final", 3, 3)]
