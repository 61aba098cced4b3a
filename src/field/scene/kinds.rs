//! The kinds of node that a scene is made of, and the members of each: the one list that the parser, the documentation's
//! schema and the error messages share.

/// A kind of node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kind {
    /// Its name, the one member of a node.
    pub name: &'static str,
    /// Members that must be there.
    pub members: &'static [&'static str],
    /// Whether it can be in a 2-D scene.
    pub plane: bool,
    /// Whether it can be in a 3-D scene.
    pub space: bool,
}

const fn both(name: &'static str, members: &'static [&'static str]) -> Kind {
    Kind { name, members, plane: true, space: true }
}

const fn space(name: &'static str, members: &'static [&'static str]) -> Kind {
    Kind { name, members, plane: false, space: true }
}

const fn plane(name: &'static str, members: &'static [&'static str]) -> Kind {
    Kind { name, members, plane: true, space: false }
}

/// Every kind. In a 2-D scene vectors have two components and `rotate` has no `axis`.
pub const KINDS: &[Kind] = &[
    space("sphere", &["radius"]),
    space("ellipsoid", &["radii"]),
    space("box", &["half_extents"]),
    space("rounded_box", &["half_extents", "radius"]),
    both("capsule", &["from", "to", "radius"]),
    space("cylinder", &["radius", "half_height"]),
    space("cone", &["radius", "top_radius", "half_height"]),
    space("torus", &["major", "minor"]),
    both("half_space", &["normal", "offset"]),
    space("octahedron", &["size"]),
    space("hex_prism", &["radius", "half_height"]),
    space("extrude", &["polygon", "half_height"]),
    space("revolve", &["polygon", "offset"]),
    plane("circle", &["radius"]),
    plane("rectangle", &["half_extents"]),
    plane("polygon", &["points"]),
    both("union", &["of"]),
    both("intersection", &["of"]),
    both("difference", &["of"]),
    both("smooth_union", &["k", "of"]),
    both("smooth_intersection", &["k", "of"]),
    both("smooth_difference", &["k", "of"]),
    both("round", &["radius", "of"]),
    both("shell", &["thickness", "of"]),
    both("displace", &["amplitude", "frequency", "of"]),
    both("translate", &["by", "of"]),
    both("rotate", &["axis", "angle", "of"]),
    both("scale", &["factor", "of"]),
    both("mirror", &["axis", "of"]),
    both("repeat", &["spacing", "count", "of"]),
];
