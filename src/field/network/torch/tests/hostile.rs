//! Files that no writer makes: each is refused quickly, within limits, and never by a panic.

use super::*;
use std::time::{Duration, Instant};

/// What begins a stream before the object's pickle.
const HEAD: &[u8] = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.\x80\x02}q\x00.";
/// Most time that a refusal may take on a busy machine.
const QUICK: Duration = Duration::from_secs(2);

/// A stream around the pickle of an object that has no storages.
fn stream(pickle: &[u8]) -> Vec<u8> {
    [HEAD, pickle, b"\x80\x02]q\x00."].concat()
}

/// A stream of one storage, of the type and with the bytes given, and the pickle of a tensor with the given offset, shape
/// and strides, which are opcodes.
fn one_tensor(kind: &str, count: &[u8], numel: u64, data: &[u8], layout: &[u8]) -> Vec<u8> {
    let mut pickle = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((U\x07storagectorch\n".to_vec();
    pickle.extend([kind.as_bytes(), b"\nU\x010U\x03cpu", count, b"NtQ", layout, b"\x89)tR."].concat());
    [HEAD, &pickle, b"\x80\x02]U\x010a.", &numel.to_le_bytes(), data].concat()
}

/// An archive of stored entries.
fn archive(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, data) in entries {
        let mut crc = flate2::Crc::new();
        crc.update(data);
        let (at, size) = (out.len() as u32, data.len() as u32);
        let mut common = [20u16, 0, 0, 0, 0].map(u16::to_le_bytes).concat();
        common.extend([crc.sum(), size, size].map(u32::to_le_bytes).concat());
        common.extend([name.len() as u16, 0].map(u16::to_le_bytes).concat());
        out.extend([b"PK\x03\x04", &common[..], name.as_bytes(), data].concat());
        directory.extend([b"PK\x01\x02\x14\x00", &common[..], &[0; 10], &at.to_le_bytes(), name.as_bytes()].concat());
    }
    let (at, count) = (out.len() as u32, entries.len() as u16);
    out.extend(&directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    out.extend([count, count].map(u16::to_le_bytes).concat());
    out.extend([directory.len() as u32, at].map(u32::to_le_bytes).concat());
    out.extend([0, 0]);
    out
}

fn refused(bytes: &[u8]) -> FieldError {
    let start = Instant::now();
    let error = read(bytes).expect_err("a hostile file was read");
    assert!(start.elapsed() < QUICK, "{error} took {:?}", start.elapsed());
    error
}

fn malformed(bytes: &[u8], part: &str) {
    let error = refused(bytes);
    assert!(matches!(error, FieldError::Malformed { .. }), "{error}");
    assert!(error.to_string().contains(part), "{error}");
}

fn over_limit(bytes: &[u8], part: &str) {
    let error = refused(bytes);
    assert!(matches!(error, FieldError::Limit { what, .. } if what.contains(part)), "{error}");
}

fn unsupported(bytes: &[u8], part: &str) {
    let error = refused(bytes);
    assert!(matches!(&error, FieldError::Unsupported { detail } if detail.contains(part)), "{error}");
}

const FOREIGN: &[u8] = b"\x80\x02cposix\nsystem\nX\x07\x00\x00\x00echo hi\x85R.";

#[test]
fn a_foreign_global_is_refused_by_name_and_byte_in_every_spelling() {
    let inside = format!("at byte {}", HEAD.len() + 2);
    unsupported(&stream(FOREIGN), "\"posix.system\"");
    unsupported(&stream(FOREIGN), &inside);
    unsupported(&archive(&[("a/data.pkl", FOREIGN)]), "\"posix.system\" in the entry \"data.pkl\" at byte 2");
    unsupported(&stream(b"\x80\x04\x8c\x02os\x8c\x06system\x93."), "os.system");
    unsupported(&stream(b"(S'echo hi'\nios\nsystem\n."), "os.system");
    unsupported(&stream(b"\x80\x02cbuiltins\neval\n."), "builtins.eval");
    unsupported(&stream(b"\x80\x02c__builtin__\ngetattr\n."), "__builtin__.getattr");
    unsupported(&stream(b"\x80\x02ctorch.storage\n_load_from_bytes\n."), "torch.storage._load_from_bytes");
    unsupported(&stream(b"\x80\x02ctorch\nload\n."), "torch.load");
    unsupported(&stream(b"\x80\x02\x82\x01."), "extension");
    // an attribute of an allowed module is no way around
    unsupported(&stream(b"\x80\x04\x8c\x0bcollections\x8c\x0fabc.sys.modules\x93."), "abc.sys.modules");
}

#[test]
fn a_file_cut_anywhere_is_an_error_and_no_panic() {
    for file in ["views.legacy.pth", "latent_code.pth", "nested.legacy.pth"] {
        let bytes = fixture(file);
        for end in 0..bytes.len() {
            assert!(read(&bytes[..end]).is_err(), "{file} was read from {end} of its {} bytes", bytes.len());
        }
    }
}

#[test]
fn a_hand_written_tensor_is_read() {
    let data: Vec<u8> = [1.0f32, 2.0, 3.0, 4.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let bytes = one_tensor("FloatStorage", b"K\x04", 4, &data, b"K\x01K\x03\x85K\x01\x85");
    assert_eq!(read(&bytes).unwrap()[""].values, [2.0, 3.0, 4.0]);
}

#[test]
fn a_tensor_that_reaches_past_its_storage_is_refused() {
    let four = [0u8; 16];
    let make = |layout: &[u8]| one_tensor("FloatStorage", b"K\x04", 4, &four, layout);
    for layout in [
        &b"K\x02K\x03\x85K\x01\x85"[..], // offset 2, three numbers
        b"K\x00K\x03\x85K\x02\x85",      // stride 2
        b"K\x05))",                      // one number after the end
        b"K\x00K\x02K\x02\x86\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7fK\x01\x86", // a stride of 2^63 - 1
        b"\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7f)K\x00\x85", // axes and strides differ
    ] {
        let error = refused(&make(layout));
        assert!(matches!(error, FieldError::Malformed { .. }), "{error}");
    }
    malformed(&make(b"K\x02K\x03\x85K\x01\x85"), "reaches past the 4 numbers");
    malformed(&make(b"J\xff\xff\xff\xffK\x03\x85K\x01\x85"), "is -1");
    malformed(&make(b"K\x00K\x02\x85J\xff\xff\xff\xff\x85"), "is -1");
}

#[test]
fn shapes_and_storages_too_large_to_be_true_are_refused_before_they_are_allocated() {
    let two_to_60 = b"\x8a\x08\x00\x00\x00\x00\x00\x00\x00\x10";
    let huge = one_tensor("FloatStorage", two_to_60, 1 << 60, &[0; 16], b"K\x00K\x04\x85K\x01\x85");
    over_limit(&huge, "bytes of a storage");
    let two_to_62 = b"\x8a\x08\x00\x00\x00\x00\x00\x00\x00\x40";
    let wrapped = one_tensor("DoubleStorage", two_to_62, 1 << 62, &[0; 16], b"K\x00K\x04\x85K\x01\x85");
    over_limit(&wrapped, "bytes of a storage");
    // strides of 0 reach one number from any shape
    let expanded = |shape: &[u8], strides: &[u8]| {
        let layout = [b"K\x00(", shape, b"t(", strides, b"t"].concat();
        one_tensor("FloatStorage", b"K\x04", 4, &[0; 16], &layout)
    };
    over_limit(&expanded(b"J\x00\x00\x00\x10", b"K\x00"), "numbers of a checkpoint");
    let overflowing = b"J\x00\x00\x00\x40".repeat(4);
    over_limit(&expanded(&overflowing, b"K\x00K\x00K\x00K\x00"), "numbers of a checkpoint");
    // an empty tensor cannot hide axes whose product overflows
    let hidden = [&b"K\x00"[..], &overflowing].concat();
    assert!(read(&expanded(&hidden, b"K\x00K\x00K\x00K\x00K\x00")).is_err());
    over_limit(&expanded(&b"K\x01".repeat(17), &b"K\x01".repeat(17)), "axes of a tensor");
}

#[test]
fn a_tensor_named_many_times_counts_every_time() {
    // a million numbers of one storage of one number, in a list of 100 references
    let tensor = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((U\x07storagectorch\nFloatStorage\nU\x010U\x03cpuK\x01NtQK\x00J\x00\x00\x10\x00\x85K\x00\x85\x89)tRq\x01(";
    let pickle = [&tensor[..], &b"h\x01".repeat(100), b"l."].concat();
    let bytes = [HEAD, &pickle, b"\x80\x02]U\x010a.", &1u64.to_le_bytes(), &[0; 4]].concat();
    over_limit(&bytes, "numbers of a checkpoint");
}

#[test]
fn a_dictionary_that_holds_itself_is_refused() {
    malformed(&stream(b"\x80\x02}q\x00U\x01ah\x00s."), "holds itself");
    malformed(&stream(b"\x80\x02]q\x00h\x00a."), "holds itself");
    malformed(&stream(b"\x80\x02}q\x00U\x01a]q\x01h\x00ah\x01as."), "holds itself");
}

#[test]
fn deep_nesting_is_refused() {
    over_limit(&stream(&[&b"(".repeat(100_000)[..], b"."].concat()), "marks");
    over_limit(&stream(&[b"N", &b"\x85".repeat(100_000)[..], b"."].concat()), "containers in each other");
    over_limit(&stream(&[&b"]".repeat(100_000)[..], &b"a".repeat(99_999), b"."].concat()), "containers in each other");
    let from_type = b"ctorch._tensor\n_rebuild_from_type_v2\nq\x00(h\x00N)tR.";
    malformed(&stream(from_type), "made of itself");
}

#[test]
fn a_bomb_of_shared_containers_is_refused() {
    // each list holds the one before ten times: 10^30 paths from 30 lists
    let mut laughs = b"\x80\x02]q\x00".to_vec();
    for i in 0..30u8 {
        laughs.extend([&b"("[..], &[b'h', i].repeat(10), b"lq", &[i + 1]].concat());
    }
    laughs.push(b'.');
    over_limit(&stream(&laughs), "values of a checkpoint");
    // one long list of pairs that is made a dictionary again and again
    let list = [&b"NN\x86q\x00("[..], &b"h\x00".repeat(50_000), b"lq\x01"].concat();
    let calls = b"ccollections\nOrderedDict\nh\x01\x85R".repeat(5_000);
    over_limit(&stream(&[&list[..], &calls, b"."].concat()), "opcodes");
    over_limit(&stream(&b"N0".repeat(1 << 20)), "opcodes");
    over_limit(&stream(&b"N".repeat(1 << 19)), "values on the stack");
}

#[test]
fn a_container_holds_no_more_memory_than_its_members() {
    // a stack that was once long, and then many tuples of one
    let once_long = [&b"("[..], &b"N".repeat(200_000), b"1N", &b"\x85".repeat(50_000), b"("].concat();
    let pickle = [&once_long[..], &b"N".repeat(10), b"l."].concat();
    let loaded = pickle::load(&pickle, 0, "test").unwrap();
    let reserved: usize = loaded
        .containers
        .iter()
        .map(|container| match container {
            pickle::Container::List(members) | pickle::Container::Tuple(members) => members.capacity(),
            pickle::Container::Dictionary(pairs) => 2 * pairs.capacity(),
        })
        .sum();
    assert!(reserved < 4 * 60_000, "{reserved}");
}

#[test]
fn one_long_text_named_many_times_is_not_read_as_often() {
    const LONG: u32 = 8 << 20;
    let text = [&b"X"[..], &LONG.to_le_bytes(), &vec![b'x'; LONG as usize], b"q\x000"].concat();
    // 50,000 readings would be 400 GB
    let keys = [&text, &b"}("[..], &b"h\x00N".repeat(50_000), b"u."].concat();
    let start = Instant::now();
    assert!(read(&stream(&keys)).unwrap().is_empty());
    let storage = b"(U\x07storagectorch\nFloatStorage\nh\x00U\x03cpuK\x01tQ0".repeat(20_000);
    over_limit(&stream(&[&text, &storage[..], b"N."].concat()), "key of a storage");
    let globals = b"h\x00h\x00\x93".repeat(20_000);
    over_limit(&stream(&[&text, &globals[..], b"N."].concat()), "name of a global");
    assert!(start.elapsed() < QUICK);
}

#[test]
fn a_stack_that_runs_empty_is_refused() {
    for opcode in 0..=255u8 {
        for before in [&b""[..], b"(", b"N(", b"(N", b"]", b"N", b"NN", b"}N", b"NNN", b")N", b"c__builtin__\ndict\n"] {
            // whatever comes of it, it is no panic
            let _ = read(&stream(&[before, &[opcode], b"."].concat()));
        }
    }
    malformed(&stream(b"R."), "not there");
    malformed(&stream(b"."), "not there");
    malformed(&stream(b"N(."), "not there");
    malformed(&stream(b"h\x07."), "memo");
    malformed(&stream(b"t."), "mark");
    malformed(&stream(b"NNs."), "not there");
    malformed(&stream(b"}(NNNu."), "no value");
    malformed(&stream(b"\xff."), "no opcode");
    malformed(&stream(b"NN\x86R."), "not there");
    malformed(&stream(b"N)R."), "no global");
}

#[test]
fn a_length_past_the_end_is_refused() {
    for opcode in [
        &b"X\xff\xff\xff\xff"[..],
        b"\x8d\xff\xff\xff\xff\xff\xff\xff\xff",
        b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7f",
        b"T\xff\xff\xff\x7f",
        b"\x8b\xff\xff\xff\xff",
    ] {
        malformed(&stream(&[opcode, b"."].concat()), "cut short");
    }
    malformed(&[HEAD, b"S'endless"].concat(), "line");
    malformed(&stream(&[b"c", &b"x".repeat(1000)[..], b"\ny\n."].concat()), "line");
}

/// The pickle of a list of one tensor of four singles in the storage "0".
const FOUR: &[u8] = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((U\x07storagectorch\nFloatStorage\nU\x010U\x03cpuK\x04tQK\x00K\x04\x85K\x01\x85\x89)tR.";

#[test]
fn an_archive_with_a_storage_missing_or_of_another_size_is_refused() {
    assert_eq!(read(&archive(&[("a/data.pkl", FOUR), ("a/data/0", &[0; 16])])).unwrap()[""].values, [0.0; 4]);
    malformed(&archive(&[("a/data.pkl", FOUR)]), "\"a/data/0\"");
    malformed(&archive(&[("a/data.pkl", FOUR), ("b/data/0", &[0; 16])]), "\"a/data/0\"");
    malformed(&archive(&[("a/data.pkl", FOUR), ("a/data/0", &[0; 12])]), "12 bytes where its storage has 16");
    malformed(&archive(&[("a/data.pkl", FOUR), ("a/data/0", &[0; 16]), ("a/data/0", &[1; 16])]), "twice");
}

#[test]
fn other_byte_orders_and_compiled_modules_are_refused_by_name() {
    unsupported(&archive(&[("a/data.pkl", FOUR), ("a/byteorder", b"big")]), "\"big\"");
    unsupported(&archive(&[("a/data.pkl", FOUR), ("a/constants.pkl", b")."), ("a/code/x.py", b"")]), "TorchScript");
}

#[test]
fn an_archive_that_unpacks_to_more_than_it_may_is_refused() {
    use std::io::Write;
    let mut deflater = flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::best());
    for _ in 0..128 {
        deflater.write_all(&[0; 1 << 20]).unwrap();
    }
    let packed = deflater.finish().unwrap();
    let mut bytes = archive(&[("a/data.pkl", &packed)]);
    let central = bytes.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    bytes[central + 10] = 8;
    bytes[central + 24..central + 28].copy_from_slice(&(128u32 << 20).to_le_bytes());
    over_limit(&bytes, "bytes of the pickle");
}

#[test]
fn dictionaries_of_python_2_are_read() {
    // OrderedDict([[key, value]]) and byte strings for text, as versions before 1.0 wrote under Python 2
    let storage = b"(U\x07storagectorch\nFloatStorage\nU\x010U\x03cpuK\x06U\x012K\x02K\x04\x87tQ";
    let tensor = [&b"ctorch._utils\n_rebuild_tensor\n("[..], storage, b"K\x01K\x02\x85K\x02\x85tR"].concat();
    let pickle = [&b"\x80\x02ccollections\nOrderedDict\n]]U\x06weighta"[..], &tensor, b"aa\x85R."].concat();
    let data: Vec<u8> = (0..6).flat_map(|v| (v as f32).to_le_bytes()).collect();
    let bytes = [HEAD, &pickle, b"\x80\x02]U\x010a.", &6u64.to_le_bytes(), &data].concat();
    let tensors = read(&bytes).unwrap();
    assert_eq!(tensors["weight"].values, [3.0, 5.0]);
}

#[test]
fn a_later_pair_replaces_an_earlier_one_and_two_tensors_never_share_a_name() {
    let tensor = &FOUR[2..FOUR.len() - 1];
    let with =
        |rest: &[u8]| archive(&[("data.pkl", &[b"}", tensor, b"q\x010(", rest, b"u."].concat()), ("data/0", &[0; 16])]);
    assert!(read(&with(b"U\x01ah\x01U\x01aN")).unwrap().is_empty());
    malformed(&with(b"U\x03a.bh\x01U\x01a}U\x01bh\x01s"), "two tensors have the name \"a.b\"");
    malformed(&with(b"K\x01h\x01U\x011h\x01"), "two tensors have the name \"1\"");
    over_limit(&with(&[&b"X\x00\x10\x00\x00"[..], &[b'x'; 4096], b"h\x01"].concat()), "name of a tensor");
}

/// Opcodes that change what the others work on.
const OPCODES: &[u8] = b"(.012abceghijlopqrstuQRN)}]\x80\x81\x85\x86\x87\x8a\x93\x94";

#[test]
fn some_thousand_mutations_of_real_files_cause_no_panic() {
    let files = [
        "views.legacy.pth",
        "nested.legacy.pth",
        "attributes.legacy.pth",
        "latent_code.pth",
        "protocol_4.pth",
        "types.legacy.pth",
    ];
    let files = files.map(fixture);
    // a fixed sequence that looks random (splitmix64)
    let mut state = 7u64;
    let mut random = |below: usize| {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) % below as u64) as usize
    };
    for round in 0..6000 {
        let mut bytes = files[round % files.len()].clone();
        for _ in 0..=random(4) {
            let at = random(bytes.len());
            match random(4) {
                0 => bytes[at] ^= 1 << random(8),
                1 => bytes[at] = OPCODES[random(OPCODES.len())],
                2 => drop(bytes.splice(at..(at + random(9)).min(bytes.len()), std::iter::empty())),
                _ => {
                    let from = &files[random(files.len())];
                    let start = random(from.len());
                    let piece = from[start..(start + random(40)).min(from.len())].to_vec();
                    drop(bytes.splice(at..at, piece));
                }
            }
            if bytes.is_empty() {
                break;
            }
        }
        let _ = read(&bytes);
    }
}
