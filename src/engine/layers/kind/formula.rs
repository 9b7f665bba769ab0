//! Formulas of one variable, for layers that compute each value alone.

use std::ops::{Add, Mul};

/// The formula of an elementwise layer, as data: exporters write it in their language, tests evaluate it.
///
/// ```
/// use steersman::engine::layers::{Formula, Function};
///
/// let swish = Formula::X * Function::Sigmoid.of(Formula::X);
/// assert_eq!(swish.evaluate(0.0), 0.0);
/// assert!((swish.evaluate(1.0) - 1.0 / (1.0 + (-1.0f64).exp())).abs() < 1e-15);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub enum Formula {
    /// The input value.
    X,
    /// A constant.
    Number(f32),
    /// The sum of two formulas.
    Sum(Box<[Formula; 2]>),
    /// The product of two formulas.
    Product(Box<[Formula; 2]>),
    /// A function of a formula.
    Apply(Function, Box<Formula>),
}

/// A function of one variable that every exporter knows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Function {
    /// `max(x, 0)`.
    Relu,
    /// `x` where `x > 0`, else `alpha · (eˣ − 1)`.
    Elu {
        /// The limit for large negative x is −alpha.
        alpha: f32,
    },
    /// `x` where `x > 0`, else `slope · x`.
    LeakyRelu {
        /// Slope below zero.
        slope: f32,
    },
    /// `tanh x`.
    Tanh,
    /// `x / (1 + |x|)`.
    Softsign,
    /// `1 / (1 + e⁻ˣ)`.
    Sigmoid,
}

impl Function {
    /// This function of `formula`.
    pub fn of(self, formula: Formula) -> Formula {
        Formula::Apply(self, Box::new(formula))
    }

    fn evaluate(self, x: f64) -> f64 {
        match self {
            Function::Relu => x.max(0.0),
            Function::Elu { alpha } => {
                if x > 0.0 {
                    x
                } else {
                    f64::from(alpha) * x.exp_m1()
                }
            }
            Function::LeakyRelu { slope } => {
                if x > 0.0 {
                    x
                } else {
                    f64::from(slope) * x
                }
            }
            Function::Tanh => x.tanh(),
            Function::Softsign => x / (1.0 + x.abs()),
            Function::Sigmoid => 1.0 / (1.0 + (-x).exp()),
        }
    }

    /// Its constants.
    fn numbers(self) -> Vec<f32> {
        match self {
            Function::Elu { alpha } => vec![alpha],
            Function::LeakyRelu { slope } => vec![slope],
            Function::Relu | Function::Tanh | Function::Softsign | Function::Sigmoid => Vec::new(),
        }
    }
}

impl Formula {
    /// Its value at `x`.
    pub fn evaluate(&self, x: f64) -> f64 {
        match self {
            Formula::X => x,
            Formula::Number(number) => f64::from(*number),
            Formula::Sum(terms) => terms[0].evaluate(x) + terms[1].evaluate(x),
            Formula::Product(factors) => factors[0].evaluate(x) * factors[1].evaluate(x),
            Formula::Apply(function, argument) => function.evaluate(argument.evaluate(x)),
        }
    }

    /// All constants in it, those of its functions included.
    pub fn numbers(&self) -> Vec<f32> {
        match self {
            Formula::X => Vec::new(),
            Formula::Number(number) => vec![*number],
            Formula::Sum(parts) | Formula::Product(parts) => parts.iter().flat_map(Formula::numbers).collect(),
            Formula::Apply(function, argument) => [function.numbers(), argument.numbers()].concat(),
        }
    }
}

impl Add for Formula {
    type Output = Formula;

    fn add(self, other: Formula) -> Formula {
        Formula::Sum(Box::new([self, other]))
    }
}

impl Mul for Formula {
    type Output = Formula;

    fn mul(self, other: Formula) -> Formula {
        Formula::Product(Box::new([self, other]))
    }
}
