"""The last part of a mask decoder: masks at the photo's pixels, as Segment Anything judges them.

It needs `onnx` alone. The two matrices of the inputs are Segment Anything's bilinear steps, to the square and to
the photo: rows of pixels of rows of logits, and the same for columns. Of each mask of `judged_levels` come back
the pixels over `stability_offset`, those over its negative, and the mask itself: pixels over 0, packed row by
row, the first in the lowest bit, filled up to whole words of 64.
"""
import onnx

JUDGE = """
<ir_version: 8, opset_import: ["": 17]>
judge (float[prompts, kinds, GRID, GRID] masks, int64[levels] judged_levels, float[height, GRID] photo_rows,
       float[GRID, width] photo_columns, float[1] stability_offset)
    => (uint8[prompts, levels, bytes] mask_bits, float[prompts, levels, 2] mask_counts)
{
    flat = Constant <value_ints = [0, 0, -1]> ()
    bytes_of_cells = Constant <value_ints = [0, 0, -1, 8]> ()
    last = Constant <value_ints = [-1]> ()
    first = Constant <value_ints = [0]> ()
    cells_axis = Constant <value_ints = [2]> ()
    word = Constant <value_ints = [64]> ()
    word_less_one = Constant <value_ints = [63]> ()
    end_of_word = Constant <value_ints = [0, 0, 0, 0, 0, 63]> ()
    zero = Constant <value_float = 0.0> ()
    bit_values = Constant <value_floats = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0]> ()

    judged = Gather <axis = 1> (masks, judged_levels)
    wide = MatMul (judged, photo_columns)
    pixels = MatMul (photo_rows, wide)
    values = Reshape (pixels, flat)
    over = Greater (values, stability_offset)
    over_float = Cast <to = 1> (over)
    strict = ReduceSum <keepdims = 1> (over_float, last)
    lower = Neg (stability_offset)
    above = Greater (values, lower)
    above_float = Cast <to = 1> (above)
    loose = ReduceSum <keepdims = 1> (above_float, last)
    mask_counts = Concat <axis = 2> (strict, loose)

    inside = Greater (values, zero)
    inside_float = Cast <to = 1> (inside)
    padded = Pad (inside_float, end_of_word, zero)
    shape = Shape (values)
    cells = Gather <axis = 0> (shape, cells_axis)
    rounded = Add (cells, word_less_one)
    words = Div (rounded, word)
    end = Mul (words, word)
    whole = Slice (padded, first, end, cells_axis)
    eights = Reshape (whole, bytes_of_cells)
    weighed = Mul (eights, bit_values)
    packed = ReduceSum <keepdims = 0> (weighed, last)
    mask_bits = Cast <to = 2> (packed)
}
"""


def with_judge(decoder, grid):
    """A decoder with the outputs `low_res_masks` (of `grid` x `grid` cells) and `iou_predictions`, and the judge."""
    judge = onnx.parser.parse_model(JUDGE.replace("GRID", str(grid)))
    judge.ir_version = decoder.ir_version
    onnx.compose.add_prefix(judge, "judge/", rename_inputs=False, rename_outputs=False, inplace=True)
    outputs = ["low_res_masks", "iou_predictions", "mask_bits", "mask_counts"]
    return onnx.compose.merge_models(decoder, judge, [("low_res_masks", "masks")], outputs=outputs)
