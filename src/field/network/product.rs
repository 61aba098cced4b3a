//! Matrix products of a layer's weights with blocks of points: a register-blocked kernel over weights that are packed once.
//!
//! Points come in tiles of [`TILE`]. A block of numbers holds, tile after tile, one row of [`TILE`] numbers per feature, and as many
//! rows of nothing as make the number of rows a multiple of [`ROWS`]. Weights are packed in panels of [`ROWS`] rows, column after
//! column, so the kernel reads both from beginning to end: per column it takes [`ROWS`] weights and a row of points to
//! `ROWS * TILE` sums that stay in registers.
//!
//! Every sum is made in the order of the columns with fused multiply-adds, by every version of the kernel: a point gets the same
//! bits in every tile, and on every processor that has the instruction.
//!
//! What comes out of a ReLU is often zero, for points that lie together in whole rows. Matrices of which that is known
//! ([`Panels::of_zeros`]) are not multiplied with rows of nothing but zeros: the sums are the same without them, but for the sign of
//! a sum that is zero.

use std::cell::RefCell;

/// Points in a tile: three registers of AVX-512.
pub(super) const TILE: usize = 48;
/// Rows of weights in a panel: with [`TILE`] they fill 24 of the 32 registers with sums.
pub(super) const ROWS: usize = 8;
/// Numbers of a panel's product with a tile.
const SUMS: usize = ROWS * TILE;

/// The number of rows that so many features take up.
pub(super) fn padded(features: usize) -> usize {
    features.next_multiple_of(ROWS)
}

/// A matrix packed for the kernel.
pub(super) struct Panels {
    rows: usize,
    columns: usize,
    packed: Vec<f32>,
    zeros: bool,
}

thread_local! {
    /// The columns that count, one list per tile and matrix of a product.
    static LIVE: RefCell<Vec<Vec<u32>>> = const { RefCell::new(Vec::new()) };
}

impl Panels {
    /// The matrix of `rows` times `columns` numbers that `at(row, column)` gives.
    pub fn new(rows: usize, columns: usize, at: impl Fn(usize, usize) -> f32) -> Self {
        let mut packed = Vec::with_capacity(padded(rows) * columns);
        for first in (0..rows).step_by(ROWS) {
            for column in 0..columns {
                packed.extend((first..first + ROWS).map(|row| if row < rows { at(row, column) } else { 0.0 }));
            }
        }
        Self { rows, columns, packed, zeros: false }
    }

    /// Says whether rows of nothing but zeros are to be expected in what the matrix is multiplied with.
    pub fn of_zeros(self, zeros: bool) -> Self {
        Self { zeros, ..self }
    }

    /// Whether there is nothing to multiply with.
    pub fn is_empty(&self) -> bool {
        self.columns == 0
    }

    /// Lists the columns whose row in a tile is not zero from end to end, where it may be.
    fn list_live(&self, tile: &[f32], live: &mut Vec<u32>) {
        live.clear();
        if self.zeros {
            let rows = tile.chunks_exact(TILE).take(self.columns);
            // one test of all numbers together, which the compiler makes a few wide instructions
            let some = |row: &[f32]| row.iter().fold(0, |bits, x| bits | x.to_bits() << 1) != 0;
            live.extend((0..).zip(rows).filter(|(_, row)| some(row)).map(|(column, _)| column));
        }
    }

    fn panel(&self, index: usize) -> &[f32] {
        &self.packed[index * self.columns * ROWS..][..self.columns * ROWS]
    }
}

/// What a product is added to.
#[derive(Clone, Copy)]
pub(super) enum Start<'a> {
    /// Nothing.
    Zero,
    /// One number per row, and zeros for the padding.
    Bias(&'a [f32]),
    /// What is there.
    There,
}

/// The sum of the products of some matrices, all with as many rows, with one block of `tiles` tiles each, into `to`. Every piece
/// of `to` is shown to `finish`, with its place, as soon as it is done.
pub(super) fn multiply(
    parts: &[(&Panels, &[f32])],
    tiles: usize,
    start: Start<'_>,
    to: &mut [f32],
    mut finish: impl FnMut(usize, &mut [f32]),
) {
    let rows = padded(parts.iter().map(|(panels, _)| panels.rows).max().unwrap_or(0));
    assert_eq!(to.len(), tiles * rows * TILE);
    for (panels, from) in parts {
        assert!(padded(panels.rows) == rows && from.len() == tiles * padded(panels.columns) * TILE);
    }
    LIVE.with_borrow_mut(|live| {
        live.resize_with(live.len().max(parts.len() * tiles), Vec::new);
        for ((panels, from), live) in parts.iter().zip(live.chunks_exact_mut(tiles)) {
            for (from, live) in from.chunks_exact(padded(panels.columns) * TILE).zip(live) {
                panels.list_live(from, live);
            }
        }
        let kernel = Kernel::detect();
        for panel in 0..rows / ROWS {
            for tile in 0..tiles {
                let at = (tile * rows + panel * ROWS) * TILE;
                let sums: &mut [f32; SUMS] = (&mut to[at..at + SUMS]).try_into().expect("a slice of that length");
                match start {
                    Start::Zero => sums.fill(0.0),
                    Start::Bias(bias) => {
                        for (row, bias) in sums.chunks_exact_mut(TILE).zip(&bias[panel * ROWS..]) {
                            row.fill(*bias);
                        }
                    }
                    Start::There => {}
                }
                for (part, (panels, from)) in parts.iter().enumerate() {
                    let features = &from[tile * padded(panels.columns) * TILE..][..panels.columns * TILE];
                    let live = panels.zeros.then_some(live[part * tiles + tile].as_slice());
                    kernel.add(panels.panel(panel), features, live, sums);
                }
                finish(at, sums);
            }
        }
    });
}

/// Numbers of a matrix as [`outer`] sums it up: whole products of a panel's rows with a tile's.
pub(super) fn outer_size(rows: usize, columns: usize) -> usize {
    padded(rows) * columns.next_multiple_of(TILE)
}

/// Where [`outer`] puts the product of a row with a column.
pub(super) fn outer_place(rows: usize, row: usize, column: usize) -> usize {
    ((column / TILE * padded(rows)) + row) * TILE + column % TILE
}

/// Numbers of scratch that [`outer`] takes.
pub(super) fn outer_scratch(columns: usize, tiles: usize) -> usize {
    tiles * TILE * (columns.next_multiple_of(TILE) + ROWS)
}

/// Adds to `to` the sums over all points of the products of a row of the block `left` with one of the block `right`: the derivatives
/// by a layer's weights, of what it was given and what came back. Blocks are as for [`multiply`], of so many features; `to` is as
/// [`outer_place`] says.
pub(super) fn outer(
    (left, rows): (&[f32], usize),
    (right, columns): (&[f32], usize),
    tiles: usize,
    scratch: &mut [f32],
    to: &mut [f32],
) {
    let (points, kernel) = (tiles * TILE, Kernel::detect());
    let (across, panel) =
        scratch[..outer_scratch(columns, tiles)].split_at_mut(points * columns.next_multiple_of(TILE));
    // both sides are turned over, so that the points are what the kernel sums over
    for (part, across) in across.chunks_exact_mut(points * TILE).enumerate() {
        let first = part * TILE;
        let here = first..(first + TILE).min(columns);
        for (tile, across) in across.chunks_exact_mut(TILE * TILE).enumerate() {
            let from = &right[(tile * padded(columns) + first) * TILE..][..here.len() * TILE];
            turn(from, here.len(), TILE, across);
        }
    }
    for first in (0..rows).step_by(ROWS) {
        for (tile, panel) in panel.chunks_exact_mut(TILE * ROWS).enumerate() {
            turn(&left[(tile * padded(rows) + first) * TILE..][..SUMS], ROWS, ROWS, panel);
        }
        for (part, across) in across.chunks_exact(points * TILE).enumerate() {
            let at = outer_place(rows, first, part * TILE);
            let sums: &mut [f32; SUMS] = (&mut to[at..at + SUMS]).try_into().expect("a slice of that length");
            kernel.add(panel, across, None, sums);
        }
    }
}

/// Turns `rows` rows of [`TILE`] numbers into [`TILE`] rows of `width`, of which the first `rows` numbers are written.
fn turn(from: &[f32], rows: usize, width: usize, to: &mut [f32]) {
    for (lane, to) in to.chunks_exact_mut(width).enumerate() {
        for (number, row) in to.iter_mut().zip(from.chunks_exact(TILE).take(rows)) {
            *number = row[lane];
        }
    }
}

/// The columns of a product: [`ROWS`] weights and a row of points each.
trait Columns<'a>: Iterator<Item = (&'a [f32; ROWS], &'a [f32; TILE])> + Clone {}

impl<'a, I: Iterator<Item = (&'a [f32; ROWS], &'a [f32; TILE])> + Clone> Columns<'a> for I {}

/// A version of the kernel that this processor can run.
#[derive(Clone, Copy)]
enum Kernel {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    Plain,
}

impl Kernel {
    fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if std::is_x86_feature_detected!("avx512f") {
                return Self::Avx512;
            }
            if std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma") {
                return Self::Avx2;
            }
        }
        Self::Plain
    }

    /// Adds the product of a panel with a tile's features to `sums`, of the columns in `live` where there is such a list.
    fn add(self, panel: &[f32], features: &[f32], live: Option<&[u32]>, sums: &mut [f32; SUMS]) {
        let (panel, features) = (panel.as_chunks().0, features.as_chunks().0);
        assert_eq!(panel.len(), features.len());
        let block = self.block();
        match live {
            Some(live) if live.len() < panel.len() => live.chunks(block).for_each(|live| {
                self.add_all(live.iter().map(|&k| (&panel[k as usize], &features[k as usize])), sums);
            }),
            _ => panel.chunks(block).zip(features.chunks(block)).for_each(|(panel, features)| {
                self.add_all(panel.iter().zip(features), sums);
            }),
        }
    }

    /// Columns that are gone through at once. AVX2 has too few registers for all sums, so it comes back to the same columns: so
    /// many of them (18 KiB) are still in the nearest cache then.
    fn block(self) -> usize {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => 96,
            _ => usize::MAX,
        }
    }

    #[inline(always)]
    fn add_all<'a>(self, columns: impl Columns<'a>, sums: &mut [f32; SUMS]) {
        match self {
            // SAFETY: `detect` saw that the processor has the features that the function asks for.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { add_avx512(columns, sums) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { add_avx2(columns, sums) },
            Self::Plain => add_plain(columns, sums),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn add_avx512<'a>(columns: impl Columns<'a>, sums: &mut [f32; SUMS]) {
    use std::arch::x86_64::{__m512, _mm512_fmadd_ps, _mm512_loadu_ps, _mm512_set1_ps, _mm512_storeu_ps};
    const LANES: usize = 16;
    const WIDE: usize = TILE / LANES;
    // SAFETY: reads 16 numbers at most 16 before the end of a chunk of TILE or SUMS numbers.
    let load = |row: &[f32], j: usize| -> __m512 { unsafe { _mm512_loadu_ps(row[j * LANES..][..LANES].as_ptr()) } };
    let mut sum: [[__m512; WIDE]; ROWS] = std::array::from_fn(|i| std::array::from_fn(|j| load(&sums[i * TILE..], j)));
    for (weights, points) in columns.clone() {
        let points: [__m512; WIDE] = std::array::from_fn(|j| load(points, j));
        for i in 0..ROWS {
            let weight = _mm512_set1_ps(weights[i]);
            for j in 0..WIDE {
                sum[i][j] = _mm512_fmadd_ps(weight, points[j], sum[i][j]);
            }
        }
    }
    for (row, sum) in sums.chunks_exact_mut(TILE).zip(sum) {
        for (lanes, sum) in row.chunks_exact_mut(LANES).zip(sum) {
            // SAFETY: `lanes` has as many numbers as the register.
            unsafe { _mm512_storeu_ps(lanes.as_mut_ptr(), sum) };
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn add_avx2<'a>(columns: impl Columns<'a>, sums: &mut [f32; SUMS]) {
    use std::arch::x86_64::{__m256, _mm256_fmadd_ps, _mm256_loadu_ps, _mm256_set1_ps, _mm256_storeu_ps};
    const LANES: usize = 8;
    /// Of 16 registers, eight hold sums of 4 rows and 16 points: with twelve the compiler has none left to load into, and
    /// keeps a sum on the stack.
    const WIDE: usize = 2;
    const HIGH: usize = 4;
    // SAFETY: reads the 8 numbers of a slice of that length.
    let load = |row: &[f32], j: usize| -> __m256 { unsafe { _mm256_loadu_ps(row[j * LANES..][..LANES].as_ptr()) } };
    for left in (0..TILE).step_by(WIDE * LANES) {
        for first in (0..ROWS).step_by(HIGH) {
            let mut sum: [[__m256; WIDE]; HIGH] =
                std::array::from_fn(|i| std::array::from_fn(|j| load(&sums[(first + i) * TILE + left..], j)));
            for (weights, points) in columns.clone() {
                let points: [__m256; WIDE] = std::array::from_fn(|j| load(&points[left..], j));
                for i in 0..HIGH {
                    let weight = _mm256_set1_ps(weights[first + i]);
                    for j in 0..WIDE {
                        sum[i][j] = _mm256_fmadd_ps(weight, points[j], sum[i][j]);
                    }
                }
            }
            for (i, sum) in sum.into_iter().enumerate() {
                for (j, sum) in sum.into_iter().enumerate() {
                    let lanes = &mut sums[(first + i) * TILE + left + j * LANES..][..LANES];
                    // SAFETY: `lanes` has as many numbers as the register.
                    unsafe { _mm256_storeu_ps(lanes.as_mut_ptr(), sum) };
                }
            }
        }
    }
}

/// For processors without these instructions: the same sums.
fn add_plain<'a>(columns: impl Columns<'a>, sums: &mut [f32; SUMS]) {
    for (weights, points) in columns.clone() {
        for (weight, row) in weights.iter().zip(sums.chunks_exact_mut(TILE)) {
            for (sum, point) in row.iter_mut().zip(points) {
                *sum = weight.mul_add(*point, *sum);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn number(i: usize) -> f32 {
        ((i * 7919 + 13) % 1009) as f32 / 504.5 - 1.0
    }

    /// A product in f64, number by number.
    fn plainly(rows: usize, columns: usize, from: &[f32], tile: usize, row: usize, point: usize) -> f64 {
        let feature = |column: usize| from[(tile * padded(columns) + column) * TILE + point];
        assert!(row < rows);
        (0..columns).map(|k| f64::from(number(row * columns + k)) * f64::from(feature(k))).sum()
    }

    #[test]
    fn products_of_any_shape_are_those_of_the_plain_loop_added_to_the_start() {
        for (rows, columns) in [(1, 1), (8, 3), (9, 64), (1, 200), (130, 7)] {
            let tiles = 3;
            let panels = Panels::new(rows, columns, |i, j| number(i * columns + j));
            let from: Vec<f32> = (0..tiles * padded(columns) * TILE).map(|i| number(i + 5)).collect();
            let bias: Vec<f32> = (0..padded(rows)).map(number).collect();
            let mut to = vec![0.5; tiles * padded(rows) * TILE];
            for (start, first) in [(Start::There, None), (Start::Zero, Some(0.0)), (Start::Bias(&bias), None)] {
                let before = to.clone();
                let mut seen = 0;
                multiply(&[(&panels, &from)], tiles, start, &mut to, |_, piece| seen += piece.len());
                assert_eq!(seen, to.len(), "every piece is shown once");
                for (tile, row, point) in
                    (0..tiles).flat_map(|t| (0..rows).flat_map(move |r| (0..TILE).map(move |p| (t, r, p))))
                {
                    let at = (tile * padded(rows) + row) * TILE + point;
                    let first = first.unwrap_or(match start {
                        Start::Bias(bias) => bias[row],
                        _ => before[at],
                    });
                    let expected = f64::from(first) + plainly(rows, columns, &from, tile, row, point);
                    let error = (f64::from(to[at]) - expected).abs();
                    assert!(error < 1e-6 * columns as f64, "{rows} x {columns}, row {row}: {error}");
                }
            }
        }
    }

    #[test]
    fn two_matrices_are_added_up() {
        let (one, two) = (Panels::new(5, 9, |i, j| number(i + 3 * j)), Panels::new(5, 2, |i, j| number(7 * i + j)));
        let from: [Vec<f32>; 2] = [9, 2].map(|n| (0..padded(n) * TILE).map(|i| number(i + n)).collect());
        let mut apart = vec![0.0; padded(5) * TILE];
        multiply(&[(&one, &from[0])], 1, Start::Zero, &mut apart, |_, _| {});
        multiply(&[(&two, &from[1])], 1, Start::There, &mut apart, |_, _| {});
        let mut together = vec![0.0; padded(5) * TILE];
        multiply(&[(&one, &from[0]), (&two, &from[1])], 1, Start::Zero, &mut together, |_, _| {});
        assert_eq!(apart, together);
    }

    #[test]
    fn every_version_of_the_kernel_gives_the_same_bits() {
        let columns = 37;
        let panel: Vec<f32> = (0..columns * ROWS).map(number).collect();
        let features: Vec<f32> = (0..columns * TILE).map(|i| number(i + 3)).collect();
        let with = |kernel: Kernel| {
            let mut sums: [f32; SUMS] = std::array::from_fn(number);
            kernel.add(&panel, &features, None, &mut sums);
            sums
        };
        let plain = with(Kernel::Plain);
        assert_eq!(with(Kernel::detect()), plain);
        #[cfg(target_arch = "x86_64")]
        if std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma") {
            assert_eq!(with(Kernel::Avx2), plain);
        }
    }
}
