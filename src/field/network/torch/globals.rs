//! The globals that a checkpoint may name, and what each stands for. All others are refused by name.
//!
//! A pickle asks for Python objects by module and name and calls them. Nothing is called here: a name on this list is a
//! token, and the pickle machine knows what a call of it would have made of tensors. Well-known holders of other data (the
//! options of a command line, a path, a number of numpy) are read past, since training scripts save them beside the weights.

/// How the numbers of a storage are written, little end first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    F16,
    Bf16,
    F32,
    F64,
    I8,
    U8,
    I16,
    I32,
    I64,
    Bool,
}

impl Kind {
    /// Bytes of a number.
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 | Self::Bool => 1,
            Self::F16 | Self::Bf16 | Self::I16 => 2,
            Self::F32 | Self::I32 => 4,
            Self::F64 | Self::I64 => 8,
        }
    }
}

/// What a global stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Global {
    /// A dictionary of some kind: a call gives one, from pairs or from another where it is given them.
    Dictionary,
    /// A sequence of some kind: a call gives what it is given.
    Sequence,
    /// A tensor from (storage, offset, shape, strides, …).
    RebuildTensor,
    /// A parameter: the tensor that it is called with first.
    RebuildParameter,
    /// A call of the first argument with the third, a tuple, for tensors that carry attributes.
    RebuildFromType,
    /// A type of storage.
    Storage(Kind),
    /// Something else that is harmless and holds no tensor: a call gives a value that is read past.
    Holder,
}

impl Global {
    /// The meaning of `module.name`, where it is on the list. Names of Python 2 are there too, for protocol 2 has them.
    pub fn find(module: &str, name: &str) -> Option<Self> {
        Some(match (module, name) {
            ("collections", "OrderedDict" | "defaultdict" | "Counter") => Self::Dictionary,
            ("builtins" | "__builtin__", _) => return Self::builtin(name),
            ("torch._utils", "_rebuild_tensor" | "_rebuild_tensor_v2") => Self::RebuildTensor,
            ("torch._utils", "_rebuild_parameter" | "_rebuild_parameter_with_state") => Self::RebuildParameter,
            ("torch._tensor", "_rebuild_from_type_v2") => Self::RebuildFromType,
            ("torch", "Size") => Self::Sequence,
            ("torch.storage", "UntypedStorage") => Self::Storage(Kind::U8),
            ("torch.nn.parameter", "Parameter") => Self::Holder,
            ("torch", _) => return Self::of_torch(name),
            ("argparse", "Namespace") | ("_codecs", "encode") => Self::Holder,
            ("pathlib" | "pathlib._local", "PosixPath" | "WindowsPath" | "PurePosixPath" | "PureWindowsPath") => {
                Self::Holder
            }
            ("numpy", "dtype" | "ndarray") => Self::Holder,
            ("numpy.core.multiarray" | "numpy._core.multiarray", "scalar" | "_reconstruct") => Self::Holder,
            ("numpy.dtypes", _) if name.ends_with("DType") => Self::Holder,
            _ => return None,
        })
    }

    fn builtin(name: &str) -> Option<Self> {
        Some(match name {
            "dict" => Self::Dictionary,
            "list" | "tuple" => Self::Sequence,
            "set" | "frozenset" | "bytearray" | "bytes" | "complex" | "slice" | "range" | "int" | "float" | "bool"
            | "str" | "object" => Self::Holder,
            _ => return None,
        })
    }

    fn of_torch(name: &str) -> Option<Self> {
        Some(match name {
            "HalfStorage" => Self::Storage(Kind::F16),
            "BFloat16Storage" => Self::Storage(Kind::Bf16),
            "FloatStorage" => Self::Storage(Kind::F32),
            "DoubleStorage" => Self::Storage(Kind::F64),
            "CharStorage" => Self::Storage(Kind::I8),
            "ByteStorage" | "UntypedStorage" => Self::Storage(Kind::U8),
            "ShortStorage" => Self::Storage(Kind::I16),
            "IntStorage" => Self::Storage(Kind::I32),
            "LongStorage" => Self::Storage(Kind::I64),
            "BoolStorage" => Self::Storage(Kind::Bool),
            "device" | "Tensor" | "float16" | "half" | "bfloat16" | "float32" | "float" | "float64" | "double"
            | "int8" | "uint8" | "int16" | "int32" | "int64" | "bool" => Self::Holder,
            _ => return None,
        })
    }
}
