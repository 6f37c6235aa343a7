from registration.detect import face478_points as points


def test_regions_are_disjoint_indices_of_the_scheme():
    indices = [index for region in points.REGIONS.values() for index in region]
    assert len(set(indices)) == len(indices) and min(indices) >= 0 and max(indices) < points.COUNT


def test_polygons_visit_both_lines_once():
    assert len(points.LIPS_OUTER) == len(points.LIPS_INNER) == 20
    assert len(points.RIGHT_LIDS) == len(points.LEFT_LIDS) == 16 and len(points.LEFT_BROW) == 10
    assert points.RIGHT_LIDS[0] == 33 and points.RIGHT_LIDS[8] == 133 and points.RIGHT_LIDS[9] == 155
    assert len(set(points.FACE_OVAL)) == 36
