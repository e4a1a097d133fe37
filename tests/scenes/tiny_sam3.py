"""SAM 3 with its real classes and random weights, small enough for a test."""

import json
from pathlib import Path

SIDE = 112


def write_tiny_sam3(folder: Path) -> Path:
    """Writes config.json, model.safetensors and a tokenizer of a few words; needs `transformers`."""
    import torch
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace
    from transformers import PreTrainedTokenizerFast, Sam3VideoConfig, Sam3VideoModel

    cells = SIDE // 14
    backbone = {
        "model_type": "sam3_vit_model", "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2,
        "num_attention_heads": 2, "image_size": SIDE, "patch_size": 14, "window_size": 4, "global_attn_indexes": [1],
        "pretrain_image_size": SIDE,
    }  # fmt: skip
    vision = {
        "backbone_config": backbone, "fpn_hidden_size": 128,
        "backbone_feature_sizes": [[4 * cells] * 2, [2 * cells] * 2, [cells] * 2],
    }  # fmt: skip
    small = {"hidden_size": 128, "num_layers": 1, "num_attention_heads": 2, "intermediate_size": 64}
    detector = {
        "model_type": "sam3", "vision_config": vision, "geometry_encoder_config": small, "detr_encoder_config": small,
        "detr_decoder_config": {**small, "num_queries": 3},
        "mask_decoder_config": {"hidden_size": 128, "num_attention_heads": 2},
        "text_config": {
            "model_type": "clip_text_model", "vocab_size": 16, "hidden_size": 32, "intermediate_size": 64,
            "projection_dim": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "max_position_embeddings": 32,
            "bos_token_id": 2, "eos_token_id": 3,
        },
    }  # fmt: skip
    tracker = {
        "model_type": "sam3_tracker_video", "vision_config": vision, "image_size": SIDE, "num_maskmem": 2,
        "max_object_pointers_in_encoder": 2, "prompt_encoder_config": {"hidden_size": 128, "image_size": SIDE},
        "mask_decoder_config": {
            "hidden_size": 128, "mlp_dim": 64, "num_attention_heads": 2, "iou_head_hidden_dim": 32
        },
        "memory_attention_hidden_size": 128, "memory_attention_num_layers": 1,
        "memory_attention_feed_forward_hidden_size": 64, "memory_attention_rope_feat_sizes": [cells, cells],
        "memory_encoder_hidden_size": 128, "mask_downsampler_embed_dim": 128, "memory_fuser_embed_dim": 128,
        "memory_fuser_intermediate_dim": 64,
    }  # fmt: skip
    config = Sam3VideoConfig(
        detector_config=detector, tracker_config=tracker, low_res_mask_size=4 * cells, hotstart_delay=0,
        score_threshold_detection=0.0, new_det_thresh=0.0, recondition_every_nth_frame=0,
    )  # fmt: skip
    torch.manual_seed(0)
    Sam3VideoModel(config).save_pretrained(folder)
    words = {word: number for number, word in enumerate(("[PAD]", "[UNK]", "[BOS]", "[EOS]", "head", "right", "hand"))}
    tokenizer = Tokenizer(WordLevel(words, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = Whitespace()
    PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token="[PAD]", unk_token="[UNK]").save_pretrained(folder)
    assert json.loads((folder / "config.json").read_text())["model_type"] == "sam3_video"
    return folder
