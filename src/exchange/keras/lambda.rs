//! What a `Lambda` layer computes, found by reading its byte code; it is never executed.
//!
//! Lambda layers of steering networks compute `x / a − b` in some spelling. This module evaluates their code symbolically: the
//! stack holds constants and expressions `factor · x + offset`. An instruction that is unknown, or that leaves this form,
//! makes the function unknown; the user then has to say what it computes.

use std::collections::BTreeMap;

use data_encoding::BASE64;
use serde_json::Value;

use super::marshal::{self, Layout, Object};

/// `x · factor + offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LambdaAffine {
    pub factor: f64,
    pub offset: f64,
}

/// The function in the configuration of a `Lambda` layer, or the reason why it is unknown.
pub(super) fn function(config: &serde_json::Map<String, Value>) -> Result<LambdaAffine, String> {
    let has_extras = |value: Option<&Value>| {
        value.is_some_and(|value| match value {
            Value::Null => false,
            Value::Array(entries) => !entries.is_empty(),
            Value::Object(entries) => !entries.is_empty(),
            _ => true,
        })
    };
    let (text, defaults, closure) = match config.get("function") {
        // Keras 1 and 2: code, defaults, closure.
        Some(Value::Array(parts)) => (parts.first(), parts.get(1), parts.get(2)),
        // Keras 3.
        Some(Value::Object(object)) => {
            let inner = object.get("config").and_then(Value::as_object);
            let part = |key: &str| inner.and_then(|inner| inner.get(key));
            (part("code"), part("defaults"), part("closure"))
        }
        Some(Value::String(name)) => return Err(format!("calls the function `{name}`, whose code is not in the file")),
        _ => return Err("has no code".into()),
    };
    if has_extras(defaults) || has_extras(closure) || has_extras(config.get("arguments")) {
        return Err("has arguments beside x".into());
    }
    let text = text.and_then(Value::as_str).ok_or("has no code")?;
    affine(&code_bytes(text)).ok_or_else(|| "its byte code is not of the form x / a - b".into())
}

/// The bytes of marshalled code: Keras 1 wrote them as characters (Python's `raw_unicode_escape`), its successors in Base64.
fn code_bytes(text: &str) -> Vec<u8> {
    let packed: String = text.chars().filter(|c| !c.is_ascii_whitespace()).collect();
    if let Ok(bytes) = BASE64.decode(packed.as_bytes())
        && bytes.first().is_some_and(|kind| kind & 0x7f == b'c')
    {
        return bytes;
    }
    let mut bytes = Vec::new();
    for c in text.chars() {
        match u8::try_from(u32::from(c)) {
            Ok(byte) => bytes.push(byte),
            Err(_) => bytes.extend(format!("\\u{:04x}", u32::from(c)).bytes()),
        }
    }
    bytes
}

/// The function that the marshalled code computes, if it is of that form.
pub(super) fn affine(code: &[u8]) -> Option<LambdaAffine> {
    Layout::ALL.into_iter().find_map(|layout| {
        let object = marshal::code(code, layout)?;
        let Object::Code(code) = &*object else { return None };
        let (Object::Bytes(bytes), Object::Tuple(constants)) = (&*code.code, &*code.constants) else { return None };
        if code.arguments != 1 {
            return None;
        }
        let dialects: &[Dialect] = match layout {
            Layout::Python2 => &[Dialect::Bytes],
            Layout::Python30 => &[Dialect::Bytes, Dialect::Words],
            Layout::Python38 => &[Dialect::Words],
            Layout::Python311 => &[Dialect::Cached, Dialect::Renumbered],
        };
        dialects.iter().find_map(|dialect| run(&dialect.decode(bytes)?, constants))
    })
}

/// An instruction that the evaluation knows.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Instruction {
    /// Loads a local variable; number 0 is x.
    Load(usize),
    /// Stores into a local variable.
    Store(usize),
    /// Python 3.13 does two of these with one instruction.
    LoadLoad(usize, usize),
    StoreLoad(usize, usize),
    Constant(usize),
    Add,
    Subtract,
    Multiply,
    Divide,
    /// Python 2's `/`: whole numbers give whole numbers.
    DivideWhole,
    Negate,
    Return,
}

/// Encoding of the instructions.
#[derive(Clone, Copy, Debug)]
enum Dialect {
    /// Up to Python 3.5: one byte, or three with an operand.
    Bytes,
    /// Python 3.6 to 3.10: two bytes each.
    Words,
    /// Python 3.11 and 3.12: two bytes each, one instruction for all arithmetic, cache entries behind it.
    Cached,
    /// Python 3.13: the same with other numbers.
    Renumbered,
}

impl Dialect {
    /// The instructions of `code`; `None` if one is unknown.
    fn decode(self, code: &[u8]) -> Option<Vec<Instruction>> {
        let mut instructions = Vec::new();
        let mut rest = code;
        while let Some((&opcode, tail)) = rest.split_first() {
            let has_operand = !matches!(self, Dialect::Bytes) || opcode >= 90;
            let operand_len = if !has_operand { 0 } else { if matches!(self, Dialect::Bytes) { 2 } else { 1 } };
            let (operand, tail) = tail.split_at_checked(operand_len)?;
            rest = tail;
            let operand = operand.iter().rev().fold(0, |sum, byte| sum << 8 | usize::from(*byte));
            if let Some(instruction) = self.instruction(opcode, operand)? {
                instructions.push(instruction);
            }
        }
        Some(instructions)
    }

    /// What `opcode` means: `None` if that is unknown, `Some(None)` if nothing.
    fn instruction(self, opcode: u8, operand: usize) -> Option<Option<Instruction>> {
        use Instruction::*;
        let [nothing, load_argument, load_constant, arithmetic, negate, give_back] = match self {
            Dialect::Bytes | Dialect::Words => {
                return Some(Some(match (opcode, operand) {
                    (9, _) => return Some(None),
                    (11, _) => Negate,
                    (20, _) => Multiply,
                    (21, _) => DivideWhole,
                    (23, _) => Add,
                    (24, _) => Subtract,
                    (27, _) => Divide,
                    (83, _) => Return,
                    (100, _) => Constant(operand),
                    (124, variable) => Load(variable),
                    (125, variable) => Store(variable),
                    _ => return None,
                }));
            }
            Dialect::Cached => [151, 124, 100, 122, 11, 83],
            Dialect::Renumbered => [149, 85, 83, 45, 42, 36],
        };
        let instruction = match opcode {
            // 0 is a cache entry.
            0 => return Some(None),
            _ if opcode == nothing => return Some(None),
            _ if opcode == load_argument => Load(operand),
            125 if matches!(self, Dialect::Cached) => Store(operand),
            110 if matches!(self, Dialect::Renumbered) => Store(operand),
            // Two variables in one operand, four bits each.
            88 if matches!(self, Dialect::Renumbered) => LoadLoad(operand >> 4, operand & 15),
            111 if matches!(self, Dialect::Renumbered) => StoreLoad(operand >> 4, operand & 15),
            _ if opcode == load_constant => Constant(operand),
            _ if opcode == negate => Negate,
            _ if opcode == give_back => Return,
            _ if opcode == arithmetic => match operand {
                0 => Add,
                5 => Multiply,
                10 => Subtract,
                11 => Divide,
                _ => return None,
            },
            _ => return None,
        };
        Some(Some(instruction))
    }
}

/// An entry of the stack.
#[derive(Clone, Copy, Debug)]
enum Symbol {
    Number { value: f64, whole: bool },
    Expression(LambdaAffine),
}

/// x itself.
const ARGUMENT: Symbol = Symbol::Expression(LambdaAffine { factor: 1.0, offset: 0.0 });

/// Evaluates the instructions; `None` if they compute anything but one expression in x.
fn run(instructions: &[Instruction], constants: &[std::rc::Rc<Object>]) -> Option<LambdaAffine> {
    let mut stack = Vec::new();
    let mut variables = BTreeMap::from([(0, ARGUMENT)]);
    for (place, instruction) in instructions.iter().enumerate() {
        let symbol = match *instruction {
            Instruction::Load(variable) => *variables.get(&variable)?,
            Instruction::Store(variable) => {
                variables.insert(variable, stack.pop()?);
                continue;
            }
            Instruction::LoadLoad(first, second) => {
                stack.push(*variables.get(&first)?);
                *variables.get(&second)?
            }
            Instruction::StoreLoad(stored, loaded) => {
                variables.insert(stored, stack.pop()?);
                *variables.get(&loaded)?
            }
            Instruction::Constant(index) => match **constants.get(index)? {
                Object::Integer(value) => Symbol::Number { value: value as f64, whole: true },
                Object::Float(value) => Symbol::Number { value, whole: false },
                _ => return None,
            },
            Instruction::Negate => scaled(stack.pop()?, -1.0),
            Instruction::Return => {
                let Some(Symbol::Expression(affine)) = stack.pop() else { return None };
                let last = stack.is_empty() && place + 1 == instructions.len();
                return (last && affine.factor.is_finite() && affine.offset.is_finite()).then_some(affine);
            }
            arithmetic => {
                let right = stack.pop()?;
                combined(arithmetic, stack.pop()?, right)?
            }
        };
        stack.push(symbol);
    }
    None
}

fn scaled(symbol: Symbol, by: f64) -> Symbol {
    match symbol {
        Symbol::Number { value, whole } => Symbol::Number { value: value * by, whole },
        Symbol::Expression(LambdaAffine { factor, offset }) => {
            Symbol::Expression(LambdaAffine { factor: factor * by, offset: offset * by })
        }
    }
}

/// `left instruction right`, or `None` where that is no longer of the form.
fn combined(instruction: Instruction, left: Symbol, right: Symbol) -> Option<Symbol> {
    use Symbol::{Expression, Number};
    let sum = |left: Symbol, right: Symbol| match (left, right) {
        (Number { value: a, whole: x }, Number { value: b, whole: y }) => Number { value: a + b, whole: x && y },
        (Number { value, .. }, Expression(a)) | (Expression(a), Number { value, .. }) => {
            Expression(LambdaAffine { offset: a.offset + value, ..a })
        }
        (Expression(a), Expression(b)) => {
            Expression(LambdaAffine { factor: a.factor + b.factor, offset: a.offset + b.offset })
        }
    };
    Some(match (instruction, left, right) {
        (Instruction::Add, left, right) => sum(left, right),
        (Instruction::Subtract, left, right) => sum(left, scaled(right, -1.0)),
        (Instruction::Multiply, Number { value: a, whole: x }, Number { value: b, whole: y }) => {
            Number { value: a * b, whole: x && y }
        }
        (Instruction::Multiply, Number { value, .. }, expression)
        | (Instruction::Multiply, expression, Number { value, .. }) => scaled(expression, value),
        (Instruction::Divide | Instruction::DivideWhole, _, Number { value: 0.0, .. }) => return None,
        (Instruction::DivideWhole, Number { value: a, whole: true }, Number { value: b, whole: true }) => {
            Number { value: (a / b).floor(), whole: true }
        }
        (Instruction::Divide | Instruction::DivideWhole, Number { value: a, .. }, Number { value: b, .. }) => {
            Number { value: a / b, whole: false }
        }
        (Instruction::Divide | Instruction::DivideWhole, Expression(a), Number { value, .. }) => {
            Expression(LambdaAffine { factor: a.factor / value, offset: a.offset / value })
        }
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[derive(serde::Deserialize)]
    struct Case {
        python: String,
        source: String,
        code: String,
        factor: Option<f64>,
        offset: Option<f64>,
    }

    fn cases() -> Vec<(Case, Vec<u8>)> {
        let lines = include_str!("../../../tests/golden/lambdas.jsonl").lines();
        let byte = |hex: &str| u8::from_str_radix(hex, 16).unwrap();
        let bytes = |hex: &str| (0..hex.len()).step_by(2).map(|i| byte(&hex[i..i + 2])).collect();
        let case = |line| serde_json::from_str::<Case>(line).unwrap();
        lines.map(case).map(|case| (bytes(&case.code), case)).map(|(code, case)| (case, code)).collect()
    }

    #[test]
    fn lambdas_of_nine_pythons_are_read_or_refused() {
        let mut pythons = std::collections::BTreeSet::new();
        for (case, code) in cases() {
            let found = affine(&code);
            let what = format!("Python {}: {}", case.python, case.source);
            match (found, case.factor, case.offset) {
                (Some(found), Some(factor), Some(offset)) => {
                    assert!((found.factor - factor).abs() < 1e-12, "{what}: {found:?}");
                    assert!((found.offset - offset).abs() < 1e-12, "{what}: {found:?}");
                }
                (found, factor, _) => assert!(found.is_none() && factor.is_none(), "{what}: {found:?}"),
            }
            pythons.insert(case.python);
        }
        assert_eq!(pythons.len(), 9);
    }

    #[test]
    fn damaged_code_is_no_function_of_another_kind() {
        // Whatever a changed byte does, the answer is a finite function or none; a truncated object is never one.
        for (_, code) in cases().into_iter().filter(|(case, _)| case.source.starts_with("lambda x: x/127.5")) {
            for place in 0..code.len() {
                assert_eq!(affine(&code[..place]), None);
                for bit in 0..8 {
                    let mut damaged = code.clone();
                    damaged[place] ^= 1 << bit;
                    assert!(affine(&damaged).is_none_or(|f| f.factor.is_finite() && f.offset.is_finite()));
                }
            }
        }
    }

    #[test]
    fn both_ways_of_writing_code_are_read() {
        let (_, code) = cases().remove(0);
        let expected = LambdaAffine { factor: 1.0 / 127.5, offset: -1.0 };
        let characters: String = code.iter().map(|byte| char::from(*byte)).collect();
        let keras1 = json!({"function": [characters, null, null], "arguments": {}});
        let mut lines = BASE64.encode(&code);
        lines.insert(40, '\n');
        let keras3 = json!({"function": {"class_name": "__lambda__", "config": {"code": lines, "defaults": null}}});
        for config in [keras1, keras3] {
            assert_eq!(function(config.as_object().unwrap()).unwrap(), expected);
        }
    }

    #[test]
    fn functions_that_cannot_be_told_say_why() {
        let reason = |config: Value| function(config.as_object().unwrap()).unwrap_err();
        assert!(reason(json!({"function": "preprocess"})).contains("function `preprocess`"));
        assert!(reason(json!({"function": ["c", [1.0], null]})).contains("arguments beside x"));
        assert!(reason(json!({"function": ["nonsense", null, null]})).contains("not of the form"));
        assert_eq!(reason(json!({})), "has no code");
    }
}
