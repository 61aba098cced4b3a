//! Vertices by colour: those of one colour are no neighbours, so that each can take its step without knowing the others'.

/// Vertices by the first colour that no neighbour before them has.
pub fn colours<'a>(vertices: usize, neighbours: impl Fn(usize) -> &'a [u32]) -> Vec<Vec<u32>> {
    let mut colours: Vec<Vec<u32>> = Vec::new();
    let mut of = vec![usize::MAX; vertices];
    // the last vertex that saw a colour beside it
    let mut seen: Vec<usize> = Vec::new();
    for v in 0..vertices {
        for &u in neighbours(v) {
            if let Some(by) = seen.get_mut(of[u as usize]) {
                *by = v;
            }
        }
        let free = seen.iter().position(|&by| by != v).unwrap_or(seen.len());
        if free == seen.len() {
            seen.push(usize::MAX);
            colours.push(Vec::new());
        }
        of[v] = free;
        colours[free].push(v as u32);
    }
    colours
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_vertex_has_one_colour_and_none_that_a_neighbour_has() {
        // a wheel of five around vertex 0
        let rings: [&[u32]; 6] = [&[1, 2, 3, 4, 5], &[0, 2, 5], &[0, 1, 3], &[0, 2, 4], &[0, 3, 5], &[0, 4, 1]];
        let colours = colours(6, |v| rings[v]);
        let of = |v: u32| colours.iter().position(|c| c.contains(&v)).expect("a colour");
        assert_eq!((colours.len(), colours.iter().map(Vec::len).sum::<usize>()), (4, 6));
        assert!((0..6).all(|v| rings[v as usize].iter().all(|&u| of(u) != of(v))));
    }
}
